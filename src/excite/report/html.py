"""Runs as one self-contained HTML page."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from .. import __version__
from ..record.figure import MAX_POINTS
from . import content
from .content import Document, Element, Section
from .document import described, drawing, read_runs
from .svg import inline_svg

MAX_BYTES = 3_000_000
"""Size above which a page is drawn again with fewer points, so that it can be mailed."""
_NUM_POINTS = (MAX_POINTS, 1000, 250)
_TOO_LARGE = f"This page is larger than {MAX_BYTES / 1e6:g} MB: several pages are easier to send."
_STYLE = Path(__file__).with_name("page.css")
_NARROW = 8  # columns that fit a page that stands upright
_NARROW_FIGURE = 12.0  # inches that fit a screen


def report_html(
    runs: Sequence[Path], progress: Callable[[str, int, int], None] = lambda *_: None
) -> str:
    """A report of run folders and records as one HTML document.

    Lines of long records are thinned to their extremes, more so where the page gets large.

    Args:
        runs: folders of `excite identify`, `excite campaign` and `excite study run`, and records
             (.csv, .mat) with their sidecar.
        progress: called with what is drawn, how many are done, and the total.

    Raises:
        ValueError: for a path that cannot be read as one of them.
    """
    every = read_runs(runs)  # reports damaged files before drawing starts
    page = ""
    for points in _NUM_POINTS:
        with drawing(points):
            page = _page(described(every, runs, progress))
        if len(page.encode()) <= MAX_BYTES:
            return page
    return page.replace("<main>\n", f"<main>\n{_paragraph(_TOO_LARGE)}", 1)


def _page(document: Document) -> str:
    """The page; for several runs with a list of contents and a comparison."""
    title, sections, titles = document.title, document.sections, document.titles
    several = len(sections) > 1
    contents = _contents(sections, titles) if several else _source(sections[0])
    beside = "".join(
        f"<section>\n<h2>{text(name)}</h2>\n{_body(body)}</section>\n"
        for name, body in document.beside
    )
    body = "".join(
        f'<section id="run{i}">\n{_head(name, section) * several}{_body(section.body)}</section>\n'
        for i, (name, section) in enumerate(zip(titles, sections, strict=True), 1)
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="excite {__version__}">
<title>{text(title)}</title>
<style>
{_STYLE.read_text(encoding="utf-8")}</style>
</head>
<body>
<header><h1>{text(title)}</h1></header>
<main>
{contents}{beside}{body}</main>
<footer>Made by excite {__version__}.</footer>
</body>
</html>
"""


def text(value: str) -> str:
    """Text of a page; everything that comes from a file passes it."""
    return html.escape(value)


def _head(title: str, section: Section) -> str:
    return f"<h2>{text(title)}</h2>\n{_source(section)}"


def _source(section: Section) -> str:
    return f'<p class="source">{text(section.name)}</p>\n'


def _contents(sections: Sequence[Section], titles: Sequence[str]) -> str:
    links = "".join(
        f'<li><a href="#run{i}">{text(title)}</a> <small>{text(section.name)}</small></li>\n'
        for i, (title, section) in enumerate(zip(titles, sections, strict=True), 1)
    )
    return f'<nav aria-label="Contents"><ol>\n{links}</ol></nav>\n'


def _body(parts: Iterable[Element]) -> str:
    return "".join(map(_element, parts))


def _element(part: Element) -> str:
    match part:
        case content.Answer(sentences):
            return f'<div class="answer">\n{"".join(map(_paragraph, sentences))}</div>\n'
        case content.Heading(words):
            return f"<h3>{text(words)}</h3>\n"
        case content.Paragraph(words):
            return _paragraph(words)
        case content.Notes(paragraphs):
            return f'<div class="notes">\n{"".join(map(_paragraph, paragraphs))}</div>\n'
        case content.Bullets(items):
            lines = "".join(f"<li>{text(item)}</li>\n" for item in items)
            return f"<ul>\n{lines}</ul>\n" if lines else ""
        case content.Facts(pairs):
            lines = "".join(f"<dt>{text(n)}</dt><dd>{text(v)}</dd>\n" for n, v in pairs)
            return f"<dl>\n{lines}</dl>\n"
        case content.Table():
            return _table(part)
        case content.Figure():
            return _figure(part)
        case content.Code(lines):
            return f"<pre><code>{text(lines)}</code></pre>\n"
        case content.Folded(summary, body):
            return f"<details><summary>{text(summary)}</summary>\n{_body(body)}</details>\n"


def _paragraph(words: str) -> str:
    return f"<p>{text(words)}</p>\n"


def _table(table: content.Table) -> str:
    """A table; a wide one scrolls in its box.

    A line is drawn where the first of its words changes, and published rows are marked.
    """

    def cells(kind: str, row: Sequence[str]) -> str:
        tags = [kind if i < table.labels else f'{kind} class="number"' for i in range(len(row))]
        return "".join(f"<{t}>{text(c)}</{kind}>" for t, c in zip(tags, row, strict=True))

    lines, before = [], None
    for row in table.rows:
        classes = ["first"] * (row[0] != before) + ["published"] * ("as published" in row)
        lines.append(f'<tr class="{" ".join(classes)}">{cells("td", row)}</tr>\n')
        before = row[0]
    is_wide = len(table.header) > _NARROW
    box = _reachable(f"table: {table.title}", " wide") if is_wide else '<div class="scroll">'
    return (
        f"{box}<table>\n"
        f"<thead><tr>{cells('th', table.header)}</tr></thead>\n"
        f"<tbody>\n{''.join(lines)}</tbody></table></div>\n"
        + _paragraph(table.caption)
        * bool(table.caption)
    )


def _figure(figure: content.Figure) -> str:
    """A figure in a box that scrolls."""
    caption = text(figure.caption)
    svg = inline_svg(figure.drawn, figure.name)
    labelled = svg.replace("<svg", f'<svg role="img" aria-label="{caption}"', 1)
    is_wide = bool(figure.drawn.get_figwidth() > _NARROW_FIGURE)
    box = _reachable(f"figure: {figure.caption}") if is_wide else '<div class="scroll">'
    return f"<figure>{box}{labelled}</div><figcaption>{caption}</figcaption></figure>\n"


def _reachable(name: str, also: str = "") -> str:
    """The opening tag of a box that scrolls, also by the keyboard, with a name."""
    return f'<div class="scroll{also}" tabindex="0" role="region" aria-label="{text(name)}">'
