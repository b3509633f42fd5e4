"""A campaign: what was known after each sample, and what was decided after each round."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...description import PlantDescription, names_of
from ...files import read_columns, read_json
from ...record import Record
from ...record.figure import episode_figure
from ..answer import told_of_campaign
from ..content import Answer, Bullets, Element, Figure, Folded, Heading, Paragraph, Section, Table
from ..figures import knowledge_figure
from ..numbers import digits_for, number
from .elements import Marker, Run, again, facts, plant_facts, record_in, signals_table, understood

_MAX_RECORDS = 6  # drawn of one campaign
_CODE = """\
import json

import pandas as pd

records = [ex.read_record(path) for path in sorted(run.glob("round-*.csv"))]
campaign = json.loads((run / "campaign.json").read_text(encoding="utf-8"))
pd.DataFrame(campaign["rounds"])"""
_KNOWLEDGE = """\
from excite.report.figures import knowledge_figure

knowledge = pd.read_csv(run / "knowledge.csv")
halves = {name: values.to_numpy() for name, values in knowledge.items()}
samples = halves["sample"].astype(int)
knowledge_figure("", samples, halves, campaign["rounds"], campaign["allowed"])"""
_ADVICE = "'excite campaign' writes it again"
_SETTINGS = ("policy_hash", "spread", "most_rounds", "coast", "carry", "redesign")


@dataclass(frozen=True)
class CampaignRun(Run):
    """The folder of a campaign.

    Attributes:
        marker: the content of `run.json`, and the folder.
        content: of `campaign.json`.
        knowledge: sample, and half of the 95 % interval after it by quantity; empty without an
            estimate.
        records: of the rounds, by the number of the first round in each.
    """

    marker: Marker
    content: Mapping[str, Any]
    knowledge: Mapping[str, np.ndarray]
    records: Mapping[int, Record]

    def section(self, name: str) -> Section:
        """The section of a campaign."""
        d, c, records = self.marker.plant, self.content, [*self.records.values()]
        with understood(self.marker.folder / "campaign.json", _ADVICE):
            title = f"{d.name}: {outcome(c)}"
            expected = f"Expected before the first round: {c['expected']}."
            parts = [
                Answer(told_of_campaign(c)),
                *self._knowledge(name),
                *([Paragraph(expected)] if c["expected"] else []),
                Bullets(list(map(str, c["warnings"]))),
                Heading("What is known"),
                Table(*known_table(d, c), name="What is known of each quantity"),
                Heading("Rounds"),
                Table(*rounds_table(c["rounds"]), name="Rounds and their decisions"),
                *_rivals(c["structure"]),
                Heading("Measured"),
                signals_table(d, records) if records else Paragraph("Nothing yet."),
                *(
                    Figure(
                        episode_figure(d, record),
                        f"{name}-round{first}",
                        f"Round {first}: inputs and outputs.",
                        f"records[{i}].plot()",
                    )
                    for i, (first, record) in enumerate([*self.records.items()][:_MAX_RECORDS])
                ),
                Heading("Settings and provenance"),
                facts(
                    [
                        *((key, c[key]) for key in _SETTINGS if key in c),
                        *([("prior", _prior(c["prior"]))] if c.get("prior") else []),
                        *((key, value) for key, value in c["settings"].items() if key not in c),
                    ]
                ),
                *(again(self.marker.command, "") if self.marker.command else []),
                Folded("The plant", [plant_facts(d)]),
            ]
        return Section(title, self.marker.folder, parts, _CODE)

    def _knowledge(self, name: str) -> list[Element]:
        """The figure of what was known after each sample; nothing without an estimate."""
        if not self.knowledge:
            return []
        samples = self.knowledge["sample"].astype(int)
        rounds, allowed = self.content["rounds"], self.content["allowed"]
        drawn = knowledge_figure("", samples, self.knowledge, rounds, allowed)
        caption = (
            "Half of each 95 % interval over the one asked for. Lines: the Cramér-Rao bound at the "
            "final estimate, for the declared noise and the inputs that were played. Dots: the "
            "intervals of the estimates, by which the rounds were judged; they know the noise of "
            "the records. Rounds end at the dotted lines."
        )
        return [Figure(drawn, f"{name}-known", caption, _KNOWLEDGE)]


def _prior(known: Mapping[str, Mapping[str, Any]]) -> str:
    """What was known before the first round, in words."""
    told = {n: (own["estimate"], own["ci95_half"]) for n, own in known.items()}
    return ", ".join(f"{n} = {v:.4g} ± {h:.2g}" for n, (v, h) in told.items() if h is not None)


def outcome(content: Mapping[str, Any]) -> str:
    """How a campaign ended, and after how many samples."""
    ended = content["reason"] or content["interrupted"] or "not ended"
    count = len(content["rounds"])
    return f"{ended} ({content['num_samples']} samples in {count} round{'s' * (count != 1)})"


def read_campaign(marker: Marker) -> CampaignRun:
    """The campaign in a folder.

    Raises:
        ValueError: for a file that is damaged or missing.
    """
    folder = marker.folder
    content = read_json(folder / "campaign.json", "rounds", "estimate", "allowed", advice=_ADVICE)
    path = folder / "knowledge.csv"
    knowledge = read_columns(path, ["sample"], _ADVICE) if path.is_file() else {}
    with understood(folder / "campaign.json", _ADVICE):
        # It may be of an earlier command, with other targets.
        is_shown = content["estimate"] and {*content["allowed"]} <= {*knowledge}
        paths = {i: folder / f"round-{i:02}.csv" for i in range(1, len(content["rounds"]) + 1)}
    if content.get("carry"):  # a round that went on is in the record of the one before
        paths = {i: path for i, path in paths.items() if i == 1 or path.exists()}
    records = {i: record_in(path, marker.plant) for i, path in paths.items()}
    return CampaignRun(marker, content, knowledge if is_shown else {}, records)


def known_table(d: PlantDescription, c: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """What is known of every parameter and target, and what was asked."""
    units, rows = c.get("units") or {p.name: p.unit for p in d.parameters}, []
    for name in dict.fromkeys([*names_of(d.parameters), *c["targets"]]):
        known, target = c["estimate"].get(name), c["targets"].get(name, "")
        cells = ["–", "–", "–"]
        if known is not None:
            value, half = known["estimate"], known["ci95_half"]
            cells[0] = number(value, digits_for(value, half or np.inf))
            if half is not None:
                cells[1] = f"{half:.2g}"
                cells[2] = f"{number(100 * half / abs(value), 2)} %" if value else "–"
        reached = ""
        if target and known is not None:
            is_reached = known["ci95_half"] is not None and known["ci95_half"] <= c["allowed"][name]
            reached = "reached" if is_reached else "missed"
        rows.append([name, str(units.get(name, "")), *cells, str(target), reached])
    return ["quantity", "unit", "estimate", "± 95 %", "relative", "target", ""], rows


def rounds_table(rounds: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """What every round played, how near it came to a level, and what was decided."""
    rows = [
        [str(i), str(r["played"]), str(r["num_samples"]), f"{100 * r['nearness']:.0f} %",
         str(r["ended"]), str(r["decision"])]
        for i, r in enumerate(rounds, 1)
    ]  # fmt: skip
    return ["round", "played", "samples", "of the level", "ended", "decision"], rows


def _rivals(structure: Mapping[str, Any] | None) -> list[Element]:
    """The rivals when they were last compared; nothing without rivals."""
    if structure is None:
        return []
    rows = [[str(r["plant"]), f"{r['probability']:.4f}"] for r in structure["rivals"]]
    return [Heading("Which plant"), Table(["rival", "probability"], rows, 1, "Rivals")]
