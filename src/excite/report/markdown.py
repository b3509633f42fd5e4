"""A report as Markdown, as GitHub shows it; its figures are files."""

from __future__ import annotations

import html
import re
import textwrap
from collections.abc import Iterable
from urllib.parse import quote

from .. import __version__
from . import content
from .content import Document, Element, Section
from .tables import markdown_table

_SPECIAL = re.compile(r"[\\`*\[\]<|$~]|&(?=#?\w+;)|(?<!\w)_|_(?!\w)")
_BEGINS_A_BLOCK = re.compile(r"^(?:(\d+)(?=[.)](?:\s|$))|(?=[-+>#]))")


def markdown_page(document: Document, folder: str) -> str:
    """A report as Markdown.

    Args:
        document: what it says.
        folder: of its figures, `NAME.svg`, from the place of the page.
    """
    several = len(document.sections) > 1
    blocks = [f"# {text(document.title)}"]
    for title, body in document.beside:
        blocks += [f"## {text(title)}", *_blocks(body, 3, folder)]
    for title, section in zip(document.titles, document.sections, strict=True):
        blocks += [f"## {text(title)}"] * several
        blocks += [source(section), *_blocks(section.body, 2 + several, folder)]
    return "\n\n".join([*blocks, f"Made by excite {__version__}."]) + "\n"


def text(value: str) -> str:
    """Text on one line that is shown as it is, and never obeyed."""
    return _SPECIAL.sub(r"\\\g<0>", " ".join(value.split()))


def source(section: Section) -> str:
    """What a section was read from."""
    return f"*{text(section.name)}*"


def _blocks(parts: Iterable[Element], level: int, folder: str) -> list[str]:
    return [block for part in parts if (block := markdown(part, level, folder))]


def markdown(part: Element, level: int = 2, folder: str = "") -> str:
    """One element; empty where it says nothing.

    Args:
        part: of a document.
        level: of its headings.
        folder: of the figures.
    """
    match part:
        case content.Answer(lines) | content.Notes(lines):
            return "\n\n".join(map(_line, lines))
        case content.Heading(words):
            return f"{'#' * level} {text(words)}"
        case content.Paragraph(words):
            return _line(words)
        case content.Bullets(items):
            return "\n".join(f"- {_line(item)}" for item in items)
        case content.Facts(pairs):
            return "\n".join(f"- {_line(name)}: {text(value)}" for name, value in pairs)
        case content.Table(header, rows, labels):
            cells = [[text(cell) for cell in row] for row in rows]
            lines = "\n".join(markdown_table([text(t) for t in header], cells, labels))
            return f"{lines}\n\n{_line(part.caption)}".rstrip()
        case content.Figure(_, name, caption):
            target = quote(f"{folder}/{name}.svg")
            return f"![{text(caption)}]({target})\n\n*{text(caption)}*"
        case content.Code(lines):
            return textwrap.indent(lines, "    ")
        case content.Folded(summary, body):
            inner = "\n\n".join(_blocks(body, level + 1, folder))
            summary = f"<summary>{html.escape(summary)}</summary>"
            return f"<details>{summary}\n\n{inner}\n\n</details>"


def _line(words: str) -> str:
    """Text that begins a line, where it is no list, heading or quotation."""
    return _BEGINS_A_BLOCK.sub(r"\1\\", text(words))
