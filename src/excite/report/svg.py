"""Figures as SVG elements of a page, in the colours of its style, light and dark."""

from __future__ import annotations

import io
import re
from typing import Any
from xml.etree import ElementTree

import matplotlib.axis
import matplotlib.figure
import matplotlib.ticker

from ..record.figure import BLUE, COLOURS, GREEN, GREY, ORANGE, RED

PAGE_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # keep text searchable and the file small
    "svg.hashsalt": "excite",  # the same figure gives the same file
    "text.parse_math": False,  # names may contain $
    "legend.frameon": False,
}
"""Matplotlib's settings under which a figure for `inline_svg` is drawn."""

_NAMED = {"blue": BLUE, "orange": ORANGE, "green": GREEN, "red": RED, "grey": GREY}
_NAMED |= {"pink": COLOURS[4], "sky": COLOURS[5]}
_PAGE_COLOURS = {value.lower(): f"var(--{name})" for name, value in _NAMED.items()}
_PAGE_COLOURS["#000000"] = "currentColor"


class _PlainLog(matplotlib.ticker.LogFormatter):
    """Powers of ten as plain text, without mathematics."""

    def _num_to_string(self, x: float, *_: object) -> str:
        return f"{x:g}"


def inline_svg(figure: matplotlib.figure.Figure, prefix: str) -> str:
    """A figure as an SVG element of a page; the page's style sets its colours.

    Args:
        figure: that is made plain.
        prefix: of the figure's ids; unique on the page.
    """
    make_plain(figure)
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


def make_plain(figure: matplotlib.figure.Figure) -> None:
    """Takes the title of a figure, because a report has captions, and mathematics from its axes."""
    if figure.get_suptitle():
        figure.suptitle("")
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() in ("log", "symlog"):
                _set_plain(axis)


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
