"""What all sections of a report are made of: text, tables, figures, settings in words.

Everything that comes from a file passes `text`, so that it is shown and never obeyed.
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
from ..figure import inline_svg
from ..numbers import number

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
        """Last part of where it was read from; where the rest lies is nobody's business."""
        return self.source.absolute().name


@dataclass(frozen=True)
class Marker:
    """`run.json`: what a run folder is.

    Attributes:
        folder: that it lies in.
        kind: of run.
        plant: that it is about.
        version: of the program that made it.
        command: that made it; empty where it is not known.
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
        """Of a run folder; ValueError where it is damaged, missing or of another kind."""
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
    """What a report shows in one section."""

    @abc.abstractmethod
    def section(self, name: str) -> Section:
        """What the report says of it; `name` begins the names of its figures."""


@contextlib.contextmanager
def understood(path: Path, advice: str = "") -> Iterator[None]:
    """Whatever in a file is not as it was written becomes one sentence that names the file."""
    try:
        yield
    except (LookupError, TypeError, AttributeError, ArithmeticError, ValueError) as error:
        raise damaged(path, advice) from error


def text(value: object) -> str:
    """A value as text of a page, whatever characters are in it."""
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
    """A table that scrolls in a box of its own where it is wide.

    Args:
        name: what it is, for those who cannot see it; default the titles of its columns.
        labels: how many columns are words; a line is drawn where the first of them changes,
            and published rows look different.
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
    """Names and values below each other; values in words, those that say nothing left out."""
    rows = [(name, in_words(value)) for name, value in pairs]
    body = "".join(f"<dt>{text(n)}</dt><dd>{text(v)}</dd>\n" for n, v in rows if v)
    return f"<dl>\n{body}</dl>\n"


def folded(summary: str, body: str) -> str:
    """What not every reader wants to see; it opens on a click, and in print."""
    return f"<details><summary>{text(summary)}</summary>\n{body}</details>\n"


def figure(drawn: matplotlib.figure.Figure, name: str, caption: str) -> str:
    """A figure in a box that scrolls; `name` is its own on the page."""
    svg = inline_svg(drawn, name)
    labelled = svg.replace("<svg", f'<svg role="img" aria-label="{text(caption)}"', 1)
    is_wide = bool(drawn.get_figwidth() > _NARROW_FIGURE)
    box = _reachable(f"figure: {caption}") if is_wide else '<div class="scroll">'
    return f"<figure>{box}{labelled}</div><figcaption>{text(caption)}</figcaption></figure>\n"


def _reachable(name: str, also: str = "") -> str:
    """The beginning of a box that scrolls on a usual screen: by the keyboard, too, and named."""
    return f'<div class="scroll{also}" tabindex="0" role="region" aria-label="{text(name)}">'


def command(kept: str | None, likely: str) -> str:
    """What to type to do it again: as the run folder says, or as it most likely was."""
    remark = "" if kept else paragraph("The run folder does not say; most likely:")
    return f"{heading('Do it again')}{remark}<pre><code>{text(kept or likely)}</code></pre>\n"


def in_words(value: object) -> str:
    """Settings as people read them: 'amplitude 7.2, clock 4'; nothing for none."""
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
    """All that a description says of a plant."""
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
    """A record as it is, of whatever size its values are.

    Raises:
        ValueError: for a file that cannot be read.
    """
    return read_record(path, d, scales=dict.fromkeys(d.columns, 1.0))


def origin_in_words(record: Record) -> str:
    """What the sidecar says of where a record comes from."""
    provenance, ended = (record.metadata.get(key) for key in ("provenance", "ended"))
    parts = dict(provenance) if isinstance(provenance, Mapping) else {}
    if isinstance(ended, Mapping):
        parts["ended"] = ended.get("reason")
    return in_words(parts) or "no sidecar"


def signals_table(d: PlantDescription, records: Collection[Record]) -> str:
    """Extremes of every input and output over some records, and what was reached."""
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
