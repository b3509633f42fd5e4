"""Experiments drawn over time, and what all figures share: axes, levels, colours, files.

Here and in the command line angles are in degrees and fractions in percent; elsewhere in SI units.
"""

from __future__ import annotations

import contextlib
import io
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import matplotlib.axes
import matplotlib.figure
import numpy as np

from ..description import Input, Output, PlantDescription, display_unit, with_unit
from ..files import require_folder, write_bytes

Axes = np.ndarray
"""A grid of Matplotlib's axes: rows, columns."""

# Distinguishable with any colour vision (M. Okabe and K. Ito, 2008).
BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#767676"
COLOURS = (BLUE, ORANGE, GREEN, RED, "#CC79A7", "#56B4E9")
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
    """A figure as the content of a png, svg or pdf file, which holds no date."""
    buffer, dates = io.BytesIO(), {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    figure.savefig(buffer, format=kind, dpi=150, metadata=dates.get(kind))
    return buffer.getvalue()


@runtime_checkable
class Samples(Protocol):
    """What is drawn of a record, one row per sample."""

    @property
    def time(self) -> np.ndarray:
        """Sampling instants [s]."""
        ...

    @property
    def inputs(self) -> np.ndarray:
        """Inputs, in SI units."""
        ...

    @property
    def outputs(self) -> np.ndarray:
        """Measured outputs, in SI units."""
        ...


class _Figure(matplotlib.figure.Figure):
    """A figure for a notebook; pyplot is not used, because its state is the user's."""

    def _repr_png_(self) -> bytes:
        return image(self, "png")


def colour_of(i: int) -> str:
    """Colour of the i-th line of a figure."""
    return COLOURS[i % len(COLOURS)]


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
    return with_unit(part.name, display_unit(part.unit)[0])


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


def draw_episodes(axes: Axes, description: PlantDescription, records: Sequence[Samples]) -> None:
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


def episode_figure(description: PlantDescription, record: Samples) -> matplotlib.figure.Figure:
    """Inputs and outputs of one experiment, with the safety levels."""
    figure, axes = new_figure(len(description.inputs) + len(description.outputs))
    draw_episodes(axes, description, [record])
    axes[-1, 0].set(xlabel="time [s]")
    add_legend(figure, *axes[:, 0])
    add_title(figure, description.name)
    return figure


def episodes_figure(
    description: PlantDescription, records: Mapping[str, Samples]
) -> matplotlib.figure.Figure:
    """Several experiments of one plant side by side, by title."""
    rows = len(description.inputs) + len(description.outputs)
    figure, axes = new_figure(rows, len(records), width=3.2 * len(records), sharey="row")
    draw_episodes(axes, description, list(records.values()))
    for column, title in enumerate(records):
        axes[0, column].set(title=title)
        axes[-1, column].set(xlabel="time [s]")
    add_legend(figure, *axes[:, 0])
    add_title(figure, f"{description.name}: nominal response")
    return figure
