"""What the sections of a report share: run folders, settings in words, tables of signals."""

from __future__ import annotations

import abc
import contextlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from ...description import Input, Output, PlantDescription, display_unit
from ...files import damaged, read_json
from ...record import Record, read_record
from ..content import Code, Element, Facts, Heading, Paragraph, Section, Table
from ..numbers import number

_NOT_STORED = "The run folder does not store the command. Most likely:"


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


def facts(pairs: Iterable[tuple[str, object]]) -> Facts:
    """Names and values in words; empty values are left out."""
    return Facts([(name, words) for name, value in pairs if (words := in_words(value))])


def again(kept: str | None, likely: str) -> list[Element]:
    """The command to repeat the run: that of the run folder, or the most likely one."""
    remark = [] if kept else [Paragraph(_NOT_STORED)]
    return [Heading("Repeat the run"), *remark, Code(kept or likely)]


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


def plant_facts(d: PlantDescription) -> Facts:
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


def signals_table(d: PlantDescription, records: Collection[Record]) -> Table:
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
    header = ["signal", "unit", "smallest", "largest", "levels"]
    return Table(header, rows, name="Measured signals")


def _reached(part: Input | Output, size: float) -> str:
    """Which safety level an output reached."""
    if isinstance(part, Input) or not (part.critical_level or part.warning_level):
        return "–"
    for word, level in (("critical", part.critical_level), ("warning", part.warning_level)):
        if level is not None and size >= level:
            return f"{word} level reached, as measured"
    return "below both"
