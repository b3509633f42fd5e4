"""Tables as plain text, HTML and Markdown, with the standard library alone."""

from __future__ import annotations

import html
import re
import textwrap
from collections.abc import Iterable, Sequence

Table = tuple[list[str], list[list[str]]]
"""Column titles and rows."""

PROSE = 40
"""Characters from which the cells of a column are broken into lines."""


def text_table(
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    width: int = 80,
    labels: int = 1,
) -> str:
    """A table as plain text, no line wider than `width` where possible.

    A table that is too wide continues below, its first columns repeated. Lines are broken
    between words only, never inside an interval such as `0.0249998 ± 2.8e-7`.

    Args:
        title: first line; none where empty.
        header: column titles; no line of titles where all are empty.
        labels: how many columns begin every part of a table that is continued below.
    """
    parts = fitting_tables(header, rows, width, labels)
    text = "\n\n".join("\n".join(_lines(names, cells, width, labels)) for names, cells in parts)
    return f"{title}\n{text}" if title else text


def _lines(
    header: Sequence[str], rows: Sequence[Sequence[str]], width: int, labels: int
) -> list[str]:
    """One table, first columns and prose to the left, the rest to the right."""
    columns = list(zip(header, *rows, strict=True))
    widths, least = [max(map(len, c)) for c in columns], list(map(_least_width, columns))
    is_left = [i < labels or max(map(len, c[1:]), default=0) > PROSE for i, c in enumerate(columns)]
    while sum(widths) + 2 * (len(widths) - 1) > width and widths != least:
        widths[max(range(len(widths)), key=lambda i: (widths[i] > least[i], widths[i]))] -= 1

    def lines(row: Sequence[str]) -> list[str]:
        cells = [_wrapped(cell, w) for cell, w in zip(row, widths, strict=True)]
        filled = [cell + [""] * (max(map(len, cells)) - len(cell)) for cell in cells]
        return [
            "  ".join(
                text.ljust(w) if left else text.rjust(w)
                for text, w, left in zip(line, widths, is_left, strict=True)
            ).rstrip()
            for line in zip(*filled, strict=True)
        ]

    rule = "─" * (sum(widths) + 2 * (len(widths) - 1))
    head = [*lines(header), rule] if any(header) else []
    return [*head, *(line for row in rows for line in lines(row))]


def _words(cell: str) -> str:
    """A cell whose intervals cannot be broken: `3 ± 1` and `3 to 4` are one word."""
    return re.sub(r"(?<=[\d–]) (±|to) (?=[-\d–])", "\N{NO-BREAK SPACE}\\1\N{NO-BREAK SPACE}", cell)


def _wrapped(cell: str, width: int) -> list[str]:
    lines = textwrap.wrap(
        _words(cell), max(width, 1), break_long_words=False, break_on_hyphens=False
    )
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines] or [""]


def _least_width(column: Sequence[str]) -> int:
    """Characters that a column needs: all of its cells, or of prose some words a line."""
    widest = max(map(len, column))
    if widest <= PROSE:
        return widest
    return min(
        widest, max(PROSE // 2, *(len(w) for cell in column for w in _words(cell).split(" ")))
    )


def fitting_tables(
    header: Sequence[str], rows: Sequence[Sequence[str]], width: int, labels: int = 2
) -> list[Table]:
    """A table as several below each other, none wider than `width` where possible.

    Each begins with the first `labels` columns; a bound stays beside its error.
    """
    needed = [2 + _least_width(column) for column in zip(header, *rows, strict=True)]
    first = list(range(labels))
    tables = [first]
    for i in range(labels, len(header)):
        if header[i] == "bound %":
            continue
        group = [i, i + 1] if header[i + 1 : i + 2] == ["bound %"] else [i]
        if tables[-1] != first and sum(needed[c] for c in tables[-1] + group) > width + 2:
            tables.append(first)
        tables[-1] = tables[-1] + group
    return [([header[c] for c in t], [[row[c] for c in t] for row in rows]) for t in tables]


def html_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as HTML, for a notebook."""

    def line(tag: str, cells: Sequence[str]) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells) + "</tr>\n"

    caption = f"<caption>{html.escape(title)}</caption>\n" if title else ""
    head = f"<thead>{line('th', header)}</thead>\n" if any(header) else ""
    body = "".join(line("td", row) for row in rows)
    return f"<table>\n{caption}{head}<tbody>\n{body}</tbody></table>\n"


def markdown_table(
    header: Sequence[str], rows: Iterable[Sequence[str]], labels: int | None = None
) -> list[str]:
    """The lines of a table as Markdown.

    Args:
        header: column titles.
        rows: of cells.
        labels: how many columns are words; numbers stand on the right. Default: all.
    """
    lines = ["| " + " | ".join(cells) + " |" for cells in (header, *rows)]
    words = len(header) if labels is None else min(labels, len(header))
    return [lines[0], "|" + " --- |" * words + " ---: |" * (len(header) - words), *lines[1:]]
