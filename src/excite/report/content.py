"""What a report says, whatever its format: text, tables, figures and settings of each run.

`html`, `markdown`, `latex` and `notebook` write the same document. Nothing here is escaped yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.figure


@dataclass(frozen=True)
class Answer:
    """What a person wants to know first, in sentences."""

    sentences: Sequence[str]


@dataclass(frozen=True)
class Heading:
    """A heading inside a section."""

    words: str


@dataclass(frozen=True)
class Paragraph:
    """A paragraph of plain text."""

    words: str


@dataclass(frozen=True)
class Notes:
    """Paragraphs in small print."""

    paragraphs: Sequence[str]


@dataclass(frozen=True)
class Bullets:
    """A list of plain texts; nothing where there are none."""

    items: Sequence[str]


@dataclass(frozen=True)
class Facts:
    """Names and values below each other."""

    pairs: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        header: titles of the columns.
        rows: of cells.
        labels: how many columns are words; the others are numbers.
        name: what it shows, in a few words; default the titles of its columns.
        caption: sentences on it; may be empty.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    labels: int = 2
    name: str = ""
    caption: str = ""

    @property
    def title(self) -> str:
        """Its name, or what the columns are called."""
        return self.name or ", ".join(filter(None, self.header))


@dataclass(frozen=True)
class Figure:
    """A figure.

    Attributes:
        drawn: by Matplotlib; its title is left out, because it has a caption.
        name: unique in the report.
        caption: sentences on it.
        code: that draws it in Python, after the code of its section; empty where there is none.
    """

    drawn: matplotlib.figure.Figure
    name: str
    caption: str
    code: str = ""


@dataclass(frozen=True)
class Code:
    """Lines to be typed."""

    lines: str


@dataclass(frozen=True)
class Folded:
    """Content that a screen shows on demand."""

    summary: str
    body: Sequence[Paragraph | Facts | Table]


Element = Answer | Heading | Paragraph | Notes | Bullets | Facts | Table | Figure | Code | Folded


@dataclass(frozen=True)
class Section:
    """One run in a report.

    Attributes:
        title: in plain text.
        source: file or folder it was read from.
        body: its content.
        code: that reads the run in Python, from the path `run`; its last line shows the run.
    """

    title: str
    source: Path
    body: Sequence[Element]
    code: str

    @property
    def name(self) -> str:
        """Last part of its path; a report does not show the rest."""
        return self.source.absolute().name


@dataclass(frozen=True)
class Document:
    """A report.

    Attributes:
        sections: of the runs.
        beside: comparisons of several runs, each with its title.
    """

    sections: Sequence[Section]
    beside: Sequence[tuple[str, Sequence[Element]]]

    @property
    def title(self) -> str:
        """That of its only section, or how many there are."""
        return self.sections[0].title if len(self.sections) == 1 else f"{len(self.sections)} runs"

    @property
    def titles(self) -> list[str]:
        """Of its sections, numbered where there are several."""
        if len(self.sections) == 1:
            return [self.title]
        return [f"{i}. {section.title}" for i, section in enumerate(self.sections, 1)]

    @property
    def figures(self) -> list[Figure]:
        """Those of all sections."""
        return [p for section in self.sections for p in section.body if isinstance(p, Figure)]
