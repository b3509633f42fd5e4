"""Studies: methods and agents compared on common plants and noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...description import PlantDescription, names_of
from ...files import folder_word, read_columns, read_json
from ...policy import POLICY_ENDING, read_policy
from ...record import Record
from ..answer import answered
from ..content import (
    Answer,
    Bullets,
    Element,
    Figure,
    Folded,
    Heading,
    Notes,
    Paragraph,
    Section,
    Table,
)
from ..figures import benchmark_figure
from ..frontier import frontier_figure, lengths_figure
from ..rows import EpisodeData, Options, StudyFacts
from ..study_figures import Curve, agents_figure, curves_figure
from ..study_table import (
    DIFFERENCES,
    StudyTable,
    common_table,
    difference_cells,
    footnotes,
)
from .elements import Marker, Run, again, facts, in_words, plant_facts, understood

_BESIDE = 4  # episodes and learning curves in one figure
_LEARNING = "Policies without exploration noise during training: median and band over the seeds."
_COMPARED = ("plant", "episodes", "num_steps", "seed", "seeds", "spread", "prior", "gain", "sensor",
             "rig", "decision", "training", "gradient")  # fmt: skip
_CODE = """\
from excite.study.table import finished_table

table = finished_table(run)
table"""
_ADVICE = "rerun 'excite study run' to write it again"


@dataclass(frozen=True)
class StudyRun(Run):
    """The run folder of a study.

    Attributes:
        marker: the content of `run.json`, and the folder.
        table: results and settings of the study.
    """

    marker: Marker
    table: StudyTable

    def section(self, name: str) -> Section:
        """The section of a study."""
        t, claims = self.table, _claims(self)
        answer = answered(t.rows, t.study, claims)
        seeds = t.best_seeds
        searched = [f"{agent}, seed {seeds[agent]}: {told}" for agent, told in claims.items()]
        header, rows = answer.table()
        parts = [
            Answer(answer.sentences),
            *_frontier(t, name),
            Table(header, rows, 1, "the excitations", answer.caption),
            *_comparisons(t, name),
            *([Heading("Searched for violations"), Bullets(searched)] if searched else []),
            *_learning(self, name),
            *_episodes(self, name),
            Heading("All results"),
            Table(*t.cells(), name=t.study.heading),
            Notes(footnotes(t.study, t.rows)),
            *_differences(t),
            *_settings(self),
        ]
        return Section(t.study.heading, self.marker.folder, parts, _CODE)


def read_study_run(marker: Marker) -> StudyRun:
    """The study in a run folder.

    Raises:
        ValueError: for a study that is not finished, and a file that is damaged or missing.
    """
    folder = marker.folder
    study = StudyFacts.read(folder / "study.json", _ADVICE)
    if not (folder / "table.json").is_file():
        again = marker.command or "excite study run"
        raise ValueError(f"{folder}: the study is not finished; rerun {again!r} to resume")
    return StudyRun(marker, StudyTable.in_folder(folder, study, _ADVICE))


def _frontier(found: StudyTable, name: str) -> list[Element]:
    """Information against violations; nothing where there is only one method."""
    if len({row.method for row in found.rows}) < 2:
        return []
    caption = "Information of each method, and how many experiments reach the critical level."
    drawn = frontier_figure(found.rows, found.study.heading)
    return [Figure(drawn, f"{name}-frontier", caption, _drawn_by("frontier"))]


def _comparisons(found: StudyTable, name: str) -> list[Element]:
    """Error against bound, bound against length."""
    rows, title = found.rows, found.study.heading
    parts: list[Element] = [
        Heading("Error against bound"),
        Figure(
            benchmark_figure(rows, title),
            f"{name}-errors",
            "Mean relative error of each method and estimator; grey: error of an efficient "
            "estimator with the same data.",
            "table.plot()",
        ),
    ]
    if any(row.bound_by_length for row in rows):
        parts += [
            Heading("Bound against length"),
            Figure(
                lengths_figure(rows, title),
                f"{name}-lengths",
                "Smallest possible standard deviation against the number of samples.",
                _drawn_by("lengths"),
            ),
        ]
    return parts


def _drawn_by(word: str) -> str:
    """Python that draws a figure of a study's rows."""
    call = f"{word}_figure(table.rows, table.study.heading)"
    return f"from excite.report.frontier import {word}_figure\n\n{call}"


def _claims(run: StudyRun) -> dict[str, str]:
    """What a search for violations found for the best seed of each agent."""
    seeds, claims = run.marker.folder / "seeds", dict[str, str]()
    for agent, seed in run.table.best_seeds.items():
        path = seeds / folder_word(agent) / f"{seed}/policy{POLICY_ENDING}"
        if path.is_file():
            claims[agent] = read_policy(path).claim
    return claims


def _learning(run: StudyRun, name: str) -> list[Element]:
    """Learning curves of all agents; empty where none are stored."""
    folder, study, plant = run.marker.folder / "seeds", run.table.study, run.marker.plant
    paths = {
        agent: [folder / folder_word(agent) / f"{seed}/curve.csv" for seed in range(study.seeds)]
        for agent in study.agents
    }
    if not all(path.is_file() for files in paths.values() for path in files):
        return []
    names = ("steps", "violation_rate", *(f"relative_error_{p.name}" for p in plant.parameters))
    advice = "delete its folder: 'excite study run' trains that seed again"
    curves: dict[str, Sequence[Curve]] = {
        agent: [read_columns(path, names, advice) for path in files]
        for agent, files in paths.items()
    }
    figures = []
    for i, part in enumerate(_groups(list(paths)), 1):
        chosen = {agent: curves[agent] for agent in part}
        with understood(folder, advice):
            drawn = curves_figure(plant, chosen, study.heading, run.table.bound_curves)
        figures.append(Figure(drawn, f"{name}-curves{i}", _LEARNING))
    return [Heading("Learning"), *figures] if figures else []


def _episodes(run: StudyRun, name: str) -> list[Element]:
    """One episode of each method and agent; empty where none is stored."""
    path, plant = run.marker.folder / "episodes.json", run.marker.plant
    caption = "Inputs, outputs with their safety levels, and running estimates."
    if not path.is_file():
        return []
    figures, content = [], read_json(path, advice=_ADVICE)
    with understood(path, _ADVICE):
        episodes = {n: _episode(plant, EpisodeData.model_validate(e)) for n, e in content.items()}
        for i, part in enumerate(_groups(list(episodes)), 1):
            chosen = {method: episodes[method] for method in part}
            drawn = agents_figure(plant, chosen, run.table.study.heading)
            figures.append(Figure(drawn, f"{name}-episodes{i}", caption))
    return [Heading("One episode each"), *figures]


def _episode(d: PlantDescription, data: EpisodeData) -> tuple[Record, np.ndarray]:
    """A record and running estimates from `episodes.json`."""

    def stacked(columns: Mapping[str, Sequence[float]], names: Sequence[str]) -> np.ndarray:
        return np.stack([np.array(columns[name]) for name in names], axis=1)

    about = {"estimator": data.estimator} | ({} if data.seed is None else {"seed": data.seed})
    inputs = stacked(data.inputs, names_of(d.inputs))
    outputs = stacked(data.outputs, names_of(d.outputs))
    record = Record(np.array(data.time), inputs, outputs, about)
    return record, stacked(data.estimate_over_true, names_of(d.parameters))


def _groups(names: Sequence[str]) -> list[Sequence[str]]:
    """Names in groups of nearly equal size, each for one figure."""
    count = -(-len(names) // _BESIDE)
    return [list(part) for part in np.array_split(np.array(names, object), count or 1) if len(part)]


def _differences(found: StudyTable) -> list[Element]:
    if not found.differences:
        return []
    title = f"Differences, {found.differences[0].estimator}"
    cells = Table(*difference_cells(found.differences), name="Differences between methods")
    return [Folded(title, [Paragraph(DIFFERENCES), cells])]


def _settings(run: StudyRun) -> list[Element]:
    """Every setting of the study, and its source."""
    s, marker = run.table.study, run.marker
    common = [
        ("plant", s.plant),
        ("episodes", s.episodes),
        ("num_steps", s.num_steps),
        ("seed", s.seed),
        ("spread", s.spread),
        ("prior", s.prior),
        ("gain", s.gain),
        ("sensor", s.sensor),
        ("training seeds of each agent", s.seeds if s.agents else None),
        ("lengths", s.lengths),
        ("clairvoyant", s.clairvoyant and s.clairvoyant.data()),
        ("decision, of all agents", s.decision),
        ("training, of all agents", s.training),
        ("gradient, of all agents", s.gradient),
        ("source of the published rows", s.source),
        ("excite", marker.version),
        ("policies (SHA-256)", marker.policies),
    ]
    agents = [
        [n, a.method, in_words(a.targets) or "all", in_words(a.decision), in_words(a.training)]
        for n, a in s.agents.items()
    ]
    parts: list[Element] = [Heading("Settings and provenance"), facts(common)]
    parts += _choices("method", "excitation", s.methods)
    parts += _choices("estimator", "kind", s.estimators)
    if agents:
        header = ["agent", "trained by", "for", "decision", "training"]
        parts.append(Table(header, agents, 5, "Agents"))
    for words, lines in (("Inferred, not stated by the source", s.inferred), ("Ours", s.ours)):
        if lines:
            parts += [Paragraph(f"{words}:"), Bullets(lines)]
    parts.append(Folded("The plant", [plant_facts(marker.plant)]))
    return parts + again(marker.command, f"excite study run {s.name}.toml --out FOLDER")


def _choices(what: str, kind: str, choices: Mapping[str, Options]) -> list[Element]:
    """A table of methods or estimators and their options; nothing where there are none."""
    rows = [
        [name, str(own[kind]), in_words({k: v for k, v in own.items() if k != kind})]
        for name, own in choices.items()
    ]
    return [Table([what, kind, "options"], rows, 3, f"{what.capitalize()}s")] if rows else []


def common_methods(numbered: Mapping[str, StudyRun]) -> list[Element]:
    """Methods of several studies side by side, by title; empty without common methods.

    Studies whose plants have other parameters or outputs are not compared.
    """
    groups: dict[tuple[str, ...], dict[str, StudyRun]] = {}
    for title, run in numbered.items():
        first = run.table.rows[0]
        columns = (*first.parameters, first.max_abs_output.output, first.max_abs_output.unit)
        groups.setdefault(columns, {})[title] = run
    alike = [group for group in groups.values() if len(group) > 1]
    return [part for group in alike for part in _compared(group)]


def _compared(group: Mapping[str, StudyRun]) -> list[Element]:
    """The table of common methods, and how the studies differ."""
    common = common_table({title: run.table for title, run in group.items()})
    if common is None:
        return [Paragraph(f"{' and '.join(group)} have no method and estimator in common.")]
    header, rows = common
    return [Table(header, rows, 3, "methods in several studies"), *_settings_beside(group)]


def _settings_beside(group: Mapping[str, StudyRun]) -> list[Element]:
    """The settings in which studies differ, which may explain differences in their results."""
    studies = [run.table.study for run in group.values()]
    every = [_flat({key: getattr(study, key) for key in _COMPARED}) for study in studies]
    rows = []
    for key in dict.fromkeys(key for own in every for key in own):
        words = [own.get(key, "–") for own in every]
        if len(set(words)) > 1:
            rows.append([key, *words])
    if not rows:
        return []
    differ = Table(["", *group], rows, 1 + len(group), "settings in which they differ")
    return [Paragraph("Settings in which they differ; a dash is the default:"), differ]


def _flat(settings: Mapping[str, object]) -> dict[str, str]:
    """Settings as text; those of a group each with its name."""
    flat = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            flat |= {f"{key}: {name}": words for name, words in _flat(value).items()}
        elif words := in_words(value):
            flat[key] = words
    return flat
