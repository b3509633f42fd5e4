"""A record: excitation, measurements, and how the experiment ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ...description import PlantDescription
from ...files import read_json
from ...record import RECORD_KIND, Record
from ...record.figure import episode_figure
from ..answer import told_of_record
from ..content import Answer, Element, Figure, Folded, Heading, Paragraph, Section
from .elements import Run, facts, plant_facts, record_in, signals_table, understood

_CODE = "record = ex.read_record(run)\nrecord"
_ABOUT_THE_FILE = ("kind", "plant", "plant_hash", "dt", "provenance", "ended", "params")


@dataclass(frozen=True)
class Recorded(Run):
    """A record and the plant that its sidecar names."""

    path: Path
    plant: PlantDescription
    record: Record

    def section(self, name: str) -> Section:
        """The section of a record."""
        d, record = self.plant, self.record
        with understood(self.path.with_suffix(".json")):
            answer, ended = Answer(told_of_record(d, record)), _ended(record.metadata)
            about = facts(
                [
                    ("samples", len(record.time)),
                    ("sampling time", f"{record.dt:.4g} s"),
                    ("duration", f"{record.time[-1] - record.time[0]:.4g} s"),
                    ("true parameters", record.metadata.get("params")),
                    *((record.metadata.get("provenance") or {}).items()),
                    *((k, v) for k, v in record.metadata.items() if k not in _ABOUT_THE_FILE),
                ]
            )
        caption = f"{self.path.name}: inputs, outputs."
        parts = [
            answer,
            *ended,
            Heading("Measured"),
            signals_table(d, [record]),
            Figure(episode_figure(d, record), f"{name}-in", caption, "record.plot()"),
            Heading("Settings and provenance"),
            about,
            Folded("The plant", [plant_facts(d)]),
        ]
        return Section(f"{d.name}: a record", self.path, parts, _CODE)


def read_recorded(path: Path) -> Recorded:
    """The record in a file.

    Raises:
        ValueError: where it cannot be read, or has no sidecar that names its plant.
    """
    sidecar = path.with_suffix(".json")
    if path.suffix.lower() not in (".csv", ".mat"):
        raise ValueError(f"{path} is neither a run folder nor a record (.csv, .mat)")
    if not sidecar.is_file():
        raise ValueError(
            f"{path} has no sidecar {sidecar.name} that names its plant; 'excite identify' with "
            "--plant and --out makes a run folder of it"
        )
    content = read_json(sidecar, "kind", "plant")
    if content["kind"] != RECORD_KIND:
        raise ValueError(f"{sidecar} is no sidecar of a record")
    with understood(sidecar):
        plant = PlantDescription.from_dict(content["plant"])
    return Recorded(path, plant, record_in(path, plant))


def _ended(metadata: Mapping[str, object]) -> list[Element]:
    """How an experiment on a rig ended; nothing for one that did not, and a simulation."""
    ended = metadata.get("ended")
    if ended is None:
        return []
    if not isinstance(ended, Mapping):
        raise TypeError("how it ended")
    details = {k: v for k, v in ended.items() if k != "reason"}
    return [Heading("How it ended"), Paragraph(str(ended["reason"])), facts(details.items())]
