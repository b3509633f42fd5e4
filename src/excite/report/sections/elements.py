"""Elements of all sections of a report: text, tables, figures, settings.

Everything that comes from a file passes `text`, which escapes it.
"""

from __future__ import annotations

import abc
import contextlib
import html
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.figure

from ...description import Input, Output, PlantDescription, display_unit
from ...files import damaged, read_json
from ...record import Record, read_record
from ..numbers import number
from ..svg import inline_svg

_NUM_LABELS = 2  # columns of words before those of numbers
_NARROW = 8  # columns that fit a page that stands upright
_NARROW_FIGURE = 12.0  # inches that fit a screen


@dataclass(frozen=True)
class Section:
    """One run in a report.

    Attributes:
        title: in plain text.
        source: file or folder it was read from.
        body: as HTML.
    """

    title: str
    source: Path
    body: str

    @property
    def name(self) -> str:
        """Last part of its path; the report does not show the rest."""
        return self.source.absolute().name


@dataclass(frozen=True)
class Marker:
    """`run.json`: kind, plant and origin of a run folder.

    Attributes:
        folder: the run folder.
        kind: of the run.
        plant: of the run.
        version: of the program that made the run.
        command: that made the run; empty where it is not known.
        policies: by method, the hash of its policy.
    """

    folder: Path
    kind: str
    plant: PlantDescription
    version: str
    command: str
    policies: Mapping[str, str]

    @classmethod
    def read(cls, folder: Path, kinds: Collection[str]) -> Marker:
        """That of a run folder; ValueError where it is damaged, missing or of another kind."""
        path = folder / "run.json"
        if not path.is_file():
            raise ValueError(f"{folder} is no run folder: it has no run.json")
        content = read_json(path, "kind")
        if content["kind"] not in list(kinds):
            raise ValueError(f"{folder} is a run of another kind: {content['kind']!r}")
        with understood(path, "rerun the command that made this run folder"):
            plant = PlantDescription.from_dict(content["plant"])
            policies = dict(content.get("policies") or {})
        version, command = (str(content.get(key) or "") for key in ("excite", "command"))
        return cls(folder, str(content["kind"]), plant, version, command, policies)


class Run(abc.ABC):
    """A run that a report shows in one section."""

    @abc.abstractmethod
    def section(self, name: str) -> Section:
        """The section of the report; `name` is the prefix of its figures' names."""


@contextlib.contextmanager
def understood(path: Path, advice: str = "") -> Iterator[None]:
    """Turns an error in the content of a file into one sentence that names the file."""
    try:
        yield
    except (LookupError, TypeError, AttributeError, ArithmeticError, ValueError) as error:
        raise damaged(path, advice) from error


def text(value: object) -> str:
    """A value as escaped text of a page."""
    return html.escape(str(value))


def paragraph(value: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{text(value)}</p>\n"


def bullets(values: Iterable[str]) -> str:
    """A list of plain texts; nothing where there are none."""
    items = "".join(f"<li>{text(value)}</li>\n" for value in values)
    return f"<ul>\n{items}</ul>\n" if items else ""


def heading(value: str) -> str:
    """A heading inside a section."""
    return f"<h3>{text(value)}</h3>\n"


def table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    labels: int = _NUM_LABELS,
    name: str = "",
) -> str:
    """A table; a wide one scrolls in its box.

    Args:
        name: for screen readers; default the titles of its columns.
        labels: how many columns are words; a line is drawn where the first of them changes,
            and published rows are marked.
    """

    def cells(kind: str, row: Sequence[str]) -> str:
        tags = [kind if i < labels else f'{kind} class="number"' for i in range(len(row))]
        return "".join(f"<{t}>{text(c)}</{kind}>" for t, c in zip(tags, row, strict=True))

    lines, before = [], None
    for row in rows:
        classes = ["first"] * (row[0] != before) + ["published"] * ("as published" in row)
        lines.append(f'<tr class="{" ".join(classes)}">{cells("td", row)}</tr>\n')
        before = row[0]
    box = '<div class="scroll">'
    if len(header) > _NARROW:
        box = _reachable(f"table: {name or ', '.join(filter(None, header))}", " wide")
    return (
        f"{box}<table>\n"
        f"<thead><tr>{cells('th', header)}</tr></thead>\n"
        f"<tbody>\n{''.join(lines)}</tbody></table></div>\n"
    )


def facts(pairs: Iterable[tuple[str, object]]) -> str:
    """Names and values below each other; empty values are left out."""
    rows = [(name, in_words(value)) for name, value in pairs]
    body = "".join(f"<dt>{text(n)}</dt><dd>{text(v)}</dd>\n" for n, v in rows if v)
    return f"<dl>\n{body}</dl>\n"


def folded(summary: str, body: str) -> str:
    """Content that is folded on the screen, and open in print."""
    return f"<details><summary>{text(summary)}</summary>\n{body}</details>\n"


def figure(drawn: matplotlib.figure.Figure, name: str, caption: str) -> str:
    """A figure in a box that scrolls; `name` is unique on the page."""
    svg = inline_svg(drawn, name)
    labelled = svg.replace("<svg", f'<svg role="img" aria-label="{text(caption)}"', 1)
    is_wide = bool(drawn.get_figwidth() > _NARROW_FIGURE)
    box = _reachable(f"figure: {caption}") if is_wide else '<div class="scroll">'
    return f"<figure>{box}{labelled}</div><figcaption>{text(caption)}</figcaption></figure>\n"


def _reachable(name: str, also: str = "") -> str:
    """The opening tag of a box that scrolls, also by the keyboard, with a name."""
    return f'<div class="scroll{also}" tabindex="0" role="region" aria-label="{text(name)}">'


def command(kept: str | None, likely: str) -> str:
    """The command to repeat the run: that of the run folder, or the most likely one."""
    remark = "" if kept else paragraph("The run folder does not store the command. Most likely:")
    return f"{heading('Repeat the run')}{remark}<pre><code>{text(kept or likely)}</code></pre>\n"


def in_words(value: object) -> str:
    """Settings as text: 'amplitude 7.2, clock 4'; empty for none."""
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {words}" for k, v in value.items() if (words := in_words(v)))
    if isinstance(value, list | tuple):
        return ", ".join(map(in_words, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.10g}"
    return "" if value is None else str(value)


def plant_facts(d: PlantDescription) -> str:
    """The content of a plant's description."""
    levels = {
        o.name: {"warning level": _level(o.warning_level, o.unit),
                 "critical level": _level(o.critical_level, o.unit)}
        for o in d.outputs
    }  # fmt: skip
    return facts(
        [
            ("plant", d.name),
            ("hash", d.hash),
            ("sampling time", f"{d.dt:g} s"),
            ("inputs", {i.name: f"{i.lower:g} to {i.upper:g} {i.unit}" for i in d.inputs}),
            ("outputs", levels),
            ("sensor noise", {o.name: f"{o.noise_sd:g} {o.unit}" for o in d.outputs}),
            ("resolution", {o.name: f"{o.resolution:g} {o.unit}" for o in d.outputs}),
            ("nominal parameters", {p.name: f"{p.nominal:g} {p.unit}" for p in d.parameters}),
            ("known constants", {c.name: f"{c.value:g} {c.unit}".strip() for c in d.constants}),
        ]
    )


def _level(value: float | None, unit: str) -> str:
    shown, factor = display_unit(unit)
    return "none" if value is None else f"{factor * value:.4g} {shown}"


def record_in(path: Path, d: PlantDescription) -> Record:
    """A record, without a check of the size of its values.

    Raises:
        ValueError: for a file that cannot be read.
    """
    return read_record(path, d, scales=dict.fromkeys(d.columns, 1.0))


def origin_in_words(record: Record) -> str:
    """The origin of a record according to its sidecar."""
    provenance, ended = (record.metadata.get(key) for key in ("provenance", "ended"))
    parts = dict(provenance) if isinstance(provenance, Mapping) else {}
    if isinstance(ended, Mapping):
        parts["ended"] = ended.get("reason")
    return in_words(parts) or "no sidecar"


def signals_table(d: PlantDescription, records: Collection[Record]) -> str:
    """Extremes of every input and output over some records, and the safety level reached."""
    rows = []
    for kind, parts in (("inputs", d.inputs), ("outputs", d.outputs)):
        for i, part in enumerate(parts):
            values = [getattr(record, kind)[:, i] for record in records]
            unit, factor = display_unit(part.unit)
            low, high = min(v.min() for v in values), max(v.max() for v in values)
            size = max(abs(low), abs(high))
            rows.append(
                [
                    part.name,
                    unit,
                    number(factor * low, 4),
                    number(factor * high, 4),
                    _reached(part, size),
                ]
            )
    return table(["signal", "unit", "smallest", "largest", "levels"], rows)


def _reached(part: Input | Output, size: float) -> str:
    """Which safety level an output reached."""
    if isinstance(part, Input) or not (part.critical_level or part.warning_level):
        return "–"
    for word, level in (("critical", part.critical_level), ("warning", part.warning_level)):
        if level is not None and size >= level:
            return f"{word} level reached, as measured"
    return "below both"
