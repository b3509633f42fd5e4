"""Functions for all figures: axes, levels, colours, files.

Here and in the command line angles are in degrees and fractions in percent; elsewhere in SI units.
"""

from __future__ import annotations

import contextlib
import io
import re
import textwrap
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import matplotlib.axes
import matplotlib.axis
import matplotlib.figure
import matplotlib.ticker
import numpy as np

from ..description import Input, Output, PlantDescription, display_unit
from ..files import require_folder, write_bytes
from ..record import Record

Axes = np.ndarray
"""A grid of Matplotlib's axes: rows, columns."""

# Distinguishable with any colour vision (M. Okabe and K. Ito, 2008).
BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#767676"
_COLOURS = (BLUE, ORANGE, GREEN, RED, "#CC79A7", "#56B4E9")
PLOT_ENDINGS = (".png", ".svg", ".pdf")
_MIN_WIDTH = 6.4  # inches; a narrower figure cuts its title and its legend
MAX_POINTS = 4000
"""Points of a line; more cannot be seen on paper and make files slow to open."""
_POINTS = ContextVar("points", default=MAX_POINTS)


def require_plot_path(path: Path) -> None:
    """Raises ValueError, before anything is computed, where a figure may not be written."""
    if path.suffix.lower() not in PLOT_ENDINGS:
        raise ValueError(f"{path}: figures end in {', '.join(PLOT_ENDINGS)}")
    require_folder(path)


def save(figure: matplotlib.figure.Figure, path: Path) -> None:
    """Writes a figure, completely or not at all."""
    write_bytes(path, image(figure, path.suffix[1:].lower()))


def image(figure: matplotlib.figure.Figure, kind: str) -> bytes:
    """A figure as the content of a png, svg or pdf file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=150)
    return buffer.getvalue()


PAGE_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # keep text searchable and the file small
    "svg.hashsalt": "excite",  # the same figure gives the same file
    "text.parse_math": False,  # names may contain $
    "legend.frameon": False,
}
"""Matplotlib's settings under which a figure for `inline_svg` is drawn."""

_NAMED = {"blue": BLUE, "orange": ORANGE, "green": GREEN, "red": RED, "grey": GREY}
_NAMED |= {"pink": _COLOURS[4], "sky": _COLOURS[5]}
_PAGE_COLOURS = {value.lower(): f"var(--{name})" for name, value in _NAMED.items()}
_PAGE_COLOURS["#000000"] = "currentColor"


class _PlainLog(matplotlib.ticker.LogFormatter):
    """Powers of ten as plain text, without mathematics."""

    def _num_to_string(self, x: float, *_: object) -> str:
        return f"{x:g}"


def inline_svg(figure: matplotlib.figure.Figure, prefix: str) -> str:
    """A figure as an SVG element of a page; the page's style sets its colours.

    It has no title, because a page has headings and captions.

    Args:
        prefix: of the figure's ids; unique on the page.
    """
    if figure.get_suptitle():
        figure.suptitle("")
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() in ("log", "symlog"):
                _set_plain(axis)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = ElementTree.fromstring(buffer.getvalue())
    for element in list(svg.iter()):
        for child in [child for child in element if child.tag.endswith(("}metadata", "}style"))]:
            element.remove(child)
    values = " ".join(value for element in svg.iter() for value in element.attrib.values())
    used = set(re.findall(r"#(\w+)", values))
    for element in svg.iter():
        element.tag = element.tag.rpartition("}")[2]
        named = {name.rpartition("}")[2]: value for name, value in element.attrib.items()}
        element.attrib = {
            name: _of_page(name, value, prefix)
            for name, value in named.items()
            if name != "id" or value in used
        }
    svg.attrib = {"viewBox": svg.attrib["viewBox"], "style": f"--width: {svg.attrib['width']}"}
    return re.sub(r"\s*\n\s*", "\n", ElementTree.tostring(svg, encoding="unicode"))


def _set_plain(axis: matplotlib.axis.Axis) -> None:
    """Few ticks of a logarithmic axis, as plain numbers."""
    axis.set_major_formatter(_PlainLog())
    axis.set_minor_formatter(_PlainLog())
    low, high = sorted(axis.get_view_interval())
    if low <= 0 or high / low > 100:  # powers of ten are enough
        axis.set_minor_locator(matplotlib.ticker.NullLocator())


def _of_page(name: str, value: str, prefix: str) -> str:
    """The value of an attribute with unique ids, the page's colours and font, short numbers."""
    if name == "id":
        return f"{prefix}-{value}"
    if name == "href":
        return value.replace("#", f"#{prefix}-")
    value = re.sub(r" ?font-family: [^;]*;", "", value.replace("url(#", f"url(#{prefix}-"))
    value = re.sub(r"(\.\d\d)\d+", r"\1", value)  # hundredths of a point cannot be seen
    return re.sub("#[0-9a-f]{6}", lambda m: _PAGE_COLOURS.get(m[0], m[0]), value)


class _Figure(matplotlib.figure.Figure):
    """A figure for a notebook; pyplot is not used, because its state is the user's."""

    def _repr_png_(self) -> bytes:
        return image(self, "png")


def colour_of(i: int) -> str:
    """Colour of the i-th line of a figure."""
    return _COLOURS[i % len(_COLOURS)]


def new_figure(
    rows: int,
    columns: int = 1,
    height: float = 2.2,
    width: float = 8.0,
    sharey: Literal["row"] | bool = False,
) -> tuple[matplotlib.figure.Figure, Axes]:
    """A figure and its grid of axes; height of one row and width of all, in inches."""
    size = max(width, _MIN_WIDTH), height * rows + 0.6
    figure = _Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharey=sharey, squeeze=False)
    for axis in axes.ravel():
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    return figure, axes


def add_title(figure: matplotlib.figure.Figure, title: str) -> None:
    """A title above all axes, broken into lines of the figure's width."""
    figure.suptitle(textwrap.fill(title, int(9 * figure.get_figwidth())))


def add_legend(figure: matplotlib.figure.Figure, *axes: matplotlib.axes.Axes) -> None:
    """One legend below all axes."""
    entries = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    if entries:
        columns = int(figure.get_figwidth() / 2)
        place = "outside lower center"
        figure.legend(entries.values(), entries, loc=place, ncols=columns, fontsize=8)


def axis_label(part: Input | Output) -> str:
    """Name and display unit."""
    return f"{part.name} [{display_unit(part.unit)[0]}]"


@contextlib.contextmanager
def at_most(points: int) -> Iterator[None]:
    """Limits the number of points of the lines in figures drawn inside."""
    token = _POINTS.set(points)
    try:
        yield
    finally:
        _POINTS.reset(token)


def thin(time: np.ndarray, *values: np.ndarray) -> list[np.ndarray]:
    """Long arrays thinned for a figure; every peak is kept."""
    kept = kept_samples(values, _POINTS.get())
    return [a[kept] for a in (time, *values)]


def kept_samples(values: Sequence[np.ndarray], points: int) -> np.ndarray:
    """Indices for a figure: both ends, and the smallest and largest value of each section.

    Args:
        values: arrays of one length, which share the indices; NaN is no peak.
    """
    length = len(values[0])
    if length <= points:
        return np.arange(length)
    stretches = max(1, (points - 2) // (2 * len(values)))
    starts = np.unique(np.linspace(0, length, stretches, endpoint=False).astype(int))
    kept = {0, length - 1}
    for array in values:
        parts = list(zip(starts, np.split(array, starts[1:]), strict=True))
        known = [(start, np.isnan(part), part) for start, part in parts]
        kept |= {start + int(np.where(gap, np.inf, v).argmin()) for start, gap, v in known}
        kept |= {start + int(np.where(gap, -np.inf, v).argmax()) for start, gap, v in known}
    return np.array(sorted(kept))


def draw_levels(axis: matplotlib.axes.Axes, part: Output, largest: float) -> None:
    """Both safety levels, if the output comes near them."""
    factor = display_unit(part.unit)[1]
    words = ((part.warning_level, ORANGE, "warning"), (part.critical_level, RED, "critical"))
    levels = [(level, *shown) for level, *shown in words if level is not None]
    if not levels or largest < 0.25 * levels[0][0]:
        return
    for level, colour, word in levels:
        for sign in (1, -1):
            label = f"{word} level" if sign == 1 else None
            axis.axhline(sign * level * factor, color=colour, ls="--", lw=1, label=label)


def draw_episodes(axes: Axes, description: PlantDescription, records: Sequence[Record]) -> None:
    """One column per experiment; one row per input, then one per output."""
    for i, part in enumerate(description.inputs):
        axes[i, 0].set(ylabel=axis_label(part))
        for axis, record in zip(axes[i], records, strict=True):
            time, values = thin(record.time, record.inputs[:, i])
            axis.step(time, values, where="post", color=GREEN, lw=1)
    for i, part in enumerate(description.outputs):
        row = axes[len(description.inputs) + i]
        row[0].set(ylabel=axis_label(part))
        largest = max(float(np.max(np.abs(record.outputs[:, i]))) for record in records)
        for axis, record in zip(row, records, strict=True):
            time, values = thin(record.time, record.outputs[:, i])
            axis.plot(time, display_unit(part.unit)[1] * values, color=BLUE, lw=1)
            draw_levels(axis, part, largest)
