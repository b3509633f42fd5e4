"""Studies and benchmarks: methods and agents compared on common plants and noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...description import PlantDescription, names_of
from ...files import folder_word, numbers_of, read_columns, read_json
from ...record import Record
from ..figures import benchmark_figure
from ..frontier import frontier_figure, lengths_figure
from ..study_figures import Curve, agents_figure, curves_figure
from ..tables import DIFFERENCES, all_cells, differences_cells, footnotes, table_cells, table_header
from .elements import (
    Section,
    bullets,
    command,
    facts,
    figure,
    folded,
    heading,
    in_words,
    paragraph,
    plant_facts,
    table,
    understood,
)

_BESIDE = 4  # episodes and learning curves in one figure
_LEARNING = "Policies without exploration noise, while they learn: median and band over the seeds."
_COMPARED = ("plant", "episodes", "num_steps", "seed", "seeds", "spread", "sensor", "rig",
             "decision", "training", "gradient")  # fmt: skip
_UNTRAINED = {"viable_seeds": None, "seeds": None, "train_seconds": None}


@dataclass(frozen=True)
class StudyRun:
    """The run folder of a study or benchmark, as it was read.

    Attributes:
        folder: where it lies.
        plant: that it is about.
        settings: the content of `study.json`.
        about: the content of `run.json`.
        content: the content of `table.json`.
    """

    folder: Path
    plant: PlantDescription
    settings: Mapping[str, Any]
    about: Mapping[str, Any]
    content: Mapping[str, Any]

    @property
    def title(self) -> str:
        """As tables and figures show it."""
        return self.settings["title"] or self.settings["name"]


def read_study_run(folder: Path, about: Mapping[str, Any]) -> StudyRun:
    """The study in a run folder.

    Raises:
        ValueError: for a study that is not finished, and a file that is damaged or missing.
    """
    advice = _advice(about)
    with understood(folder / "run.json", advice):
        plant = PlantDescription.from_dict(about["plant"])
    settings = read_json(folder / "study.json", "name", "title", "estimators", advice=advice)
    if not (folder / "table.json").is_file():
        raise ValueError(
            f"{folder}: the study is not finished; {about.get('command') or _command(about)!r} "
            "goes on with it"
        )
    content = read_json(folder / "table.json", "rows", advice=advice)
    return StudyRun(folder, plant, settings, about, content)


def _command(about: Mapping[str, Any]) -> str:
    return "excite study run" if about["kind"] == "excite study" else "excite benchmark"


def _advice(about: Mapping[str, Any]) -> str:
    return f"{_command(about)!r} writes it again"


def study_section(run: StudyRun, name: str) -> Section:
    """What the report says of a study; `name` begins the names of its figures."""
    advice = _advice(run.about)
    with understood(run.folder / "study.json", advice):
        notes = "".join(map(paragraph, footnotes(run.settings)))
        curves = {a: _curve_files(run, a) for a in run.settings.get("agents", {})}
        settings = _settings(run)
    with understood(run.folder / "table.json", advice):
        numbers = [_table(run), f'<div class="notes">\n{notes}</div>\n', _comparisons(run, name)]
        differences = _differences(run)
    shown = [*numbers, _learning(run, curves, name), _episodes(run, name), differences, settings]
    return Section(run.title, run.folder, "".join(shown))


def _table(run: StudyRun) -> str:
    """The table beside the published rows."""
    rows = run.content["rows"]
    if run.about["kind"] == "excite study":
        rows = [{**_UNTRAINED, **row} for row in rows]
    cells = all_cells(rows, run.settings.get("reference", {}))
    return table(table_header(rows), cells, name=run.title)


def _comparisons(run: StudyRun, name: str) -> str:
    """Error against bound, information against violations, bound against length."""
    rows, title = numbers_of(run.content["rows"]), run.title
    parts = [
        heading("Error against bound"),
        figure(
            benchmark_figure(rows, title),
            f"{name}-errors",
            "Mean relative error of each method and estimator; grey, what an efficient estimator "
            "would reach with the same data.",
        ),
    ]
    if len({row["method"] for row in rows if "log_det_information" in row}) > 1:
        parts += [
            heading("Information against violations"),
            figure(
                frontier_figure(rows, title),
                f"{name}-frontier",
                "Information of each method, and how many experiments reach the critical level.",
            ),
        ]
    if any("bound_by_length" in row for row in rows):
        parts += [
            heading("Bound against length"),
            figure(
                lengths_figure(rows, title),
                f"{name}-lengths",
                "Least standard deviation that experiments of so many samples allow.",
            ),
        ]
    return "".join(parts)


def _learning(run: StudyRun, paths: Mapping[str, Sequence[Path]], name: str) -> str:
    """Learning curves of all agents; nothing where they are not kept.

    Args:
        paths: of the curves, by agent, one a seed.
    """
    if not all(path.is_file() for files in paths.values() for path in files):
        return ""
    names = ("steps", "violation_rate", *(f"relative_error_{p.name}" for p in run.plant.parameters))
    advice = "delete its folder: 'excite study run' trains that seed again"
    curves: dict[str, Sequence[Curve]] = {
        agent: [read_columns(path, names, advice) for path in files]
        for agent, files in paths.items()
    }
    bounds = run.content.get("bound_curves", [a for a in paths if _is_for_information(run, a)])
    figures = []
    for i, part in enumerate(_groups(list(paths)), 1):
        with understood(run.folder / "seeds", advice):
            drawn = curves_figure(run.plant, {a: curves[a] for a in part}, run.title, bounds)
        figures.append(figure(drawn, f"{name}-curves{i}", _LEARNING))
    return heading("Learning") * bool(figures) + "".join(figures)


def _curve_files(run: StudyRun, agent: str) -> list[Path]:
    seeds = run.folder / "seeds" / folder_word(agent)
    return [seeds / str(seed) / "curve.csv" for seed in range(run.settings["seeds"])]


def _is_for_information(run: StudyRun, agent: str) -> bool:
    """Whether an agent says that it is rewarded with information; for older folders."""
    own = run.settings["agents"][agent].get("decision", {})
    return {**run.settings.get("decision", {}), **own}.get("reward") == "information"


def _episodes(run: StudyRun, name: str) -> str:
    """One episode of each method and agent; nothing where none is kept."""
    path = run.folder / "episodes.json"
    caption = "Inputs, outputs with their safety levels, and estimates while data come in."
    if not path.is_file():
        return ""
    content = numbers_of(read_json(path, advice=_advice(run.about)))
    figures = []
    with understood(path, _advice(run.about)):
        episodes = {n: _episode(run.plant, own) for n, own in content.items()}
        for i, part in enumerate(_groups(list(episodes)), 1):
            drawn = agents_figure(run.plant, {n: episodes[n] for n in part}, run.title)
            figures.append(figure(drawn, f"{name}-episodes{i}", caption))
    return heading("One episode each") + "".join(figures)


def _episode(d: PlantDescription, own: Mapping[str, Any]) -> tuple[Record, np.ndarray]:
    """A record and running estimates, as `episodes.json` has them."""

    def stacked(key: str, parts: Any) -> np.ndarray:
        return np.stack([np.array(own[key][n], float) for n in names_of(parts)], axis=1)

    about = {key: own[key] for key in ("seed", "estimator") if key in own}
    values = stacked("inputs", d.inputs), stacked("outputs", d.outputs)
    estimates = stacked("estimate_over_true", d.parameters)
    return Record(np.array(own["time"], float), *values, about), estimates


def _groups(names: Sequence[str]) -> list[Sequence[str]]:
    """Names in groups as even as can be, each for one figure."""
    count = -(-len(names) // _BESIDE)
    return [list(part) for part in np.array_split(np.array(names, object), count or 1) if len(part)]


def _differences(run: StudyRun) -> str:
    differences = run.content.get("differences")
    if not differences:
        return ""
    title = f"Differences, {differences[0]['estimator']}"
    return folded(title, paragraph(DIFFERENCES) + table(*differences_cells(differences)))


def _settings(run: StudyRun) -> str:
    """Every choice of the study in words, and where it comes from."""
    s, about = run.settings, run.about
    common = [
        ("plant", s["plant"]),
        *((key, s[key]) for key in ("episodes", "num_steps", "seed", "spread", "sensor")),
        ("training seeds of each agent", s["seeds"] if s.get("agents") else None),
        *((key, s.get(key)) for key in ("lengths", "clairvoyant")),
        *((f"{key}, of all agents", s.get(key)) for key in ("decision", "training", "gradient")),
        ("source of the published rows", s.get("source")),
        ("excite", about.get("excite")),
        ("policies (SHA-256)", about.get("policies")),
    ]
    agents = [
        [
            n,
            a["method"],
            in_words(a["targets"]) or "all",
            in_words(a["decision"]),
            in_words(a["training"]),
        ]
        for n, a in s.get("agents", {}).items()
    ]
    parts = [heading("Settings and provenance"), facts(common)]
    parts += _choices("method", "excitation", s.get("methods", {}))
    parts += _choices("estimator", "kind", s["estimators"])
    if agents:
        parts.append(table(["agent", "trained by", "for", "decision", "training"], agents, 5))
    for word, key in (("Inferred, not stated by the source", "inferred"), ("Our own", "ours")):
        if s.get(key):
            parts += [paragraph(f"{word}:"), bullets(s[key])]
    likely = f"{_command(about)} {s['name']}.toml --out FOLDER"
    again = command(about.get("command"), likely)
    return "".join([*parts, folded("The plant", plant_facts(run.plant)), again])


def _choices(what: str, kind: str, choices: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A table of methods or estimators and their options; nothing where there are none."""
    rows = [
        [name, own[kind], in_words({k: v for k, v in own.items() if k != kind})]
        for name, own in choices.items()
    ]
    return [table([what, kind, "options"], rows, 3)] if rows else []


def common_methods(numbered: Mapping[str, StudyRun]) -> str:
    """Methods that stand in several studies side by side, by title; nothing without any.

    Studies whose plants have other parameters or outputs are not compared.
    """
    groups: dict[Any, dict[str, StudyRun]] = {}
    for title, run in numbered.items():
        with understood(run.folder / "table.json", _advice(run.about)):
            first = run.content["rows"][0]
            alike = *first["relative_error_percent"], *_largest(first)
        groups.setdefault(alike, {})[title] = run
    return "".join(_compared(group) for group in groups.values() if len(group) > 1)


def _largest(row: Mapping[str, Any]) -> tuple[str, str]:
    """Which output a row tells the largest value of, and its unit."""
    return row["max_abs_output"]["output"], row["max_abs_output"]["unit"]


def _compared(group: Mapping[str, StudyRun]) -> str:
    """The table of common methods, and how the studies differ."""
    rows: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for title, run in group.items():
        for row in run.content["rows"]:
            rows.setdefault((row["method"], row["estimator"]), {})[title] = row
    common = {own: by_title for own, by_title in rows.items() if len(by_title) > 1}
    if not common:
        return paragraph(f"{' and '.join(group)} have no method and estimator in common.")
    every = [row for by_title in common.values() for row in by_title.values()]
    keys = set[str].intersection(*(set(row) for row in every)) - {"on_rig"}
    cells = []
    for by_title in common.values():
        for title, row in by_title.items():
            method, estimator, *rest = table_cells({k: row[k] for k in keys})
            cells.append([method, estimator, title, *rest])
    method, estimator, *rest = table_header([{k: every[0][k] for k in keys}])
    header = [method, estimator, "study", *rest]
    beside = table(header, cells, 3, name="methods in several studies")
    return beside + _settings_beside(group)


def _settings_beside(group: Mapping[str, StudyRun]) -> str:
    """The settings in which studies differ: what a difference in their numbers may come from."""
    every = [_flat({key: run.settings.get(key) for key in _COMPARED}) for run in group.values()]
    rows = []
    for key in dict.fromkeys(key for own in every for key in own):
        words = [own.get(key, "–") for own in every]
        if len(set(words)) > 1:
            rows.append([key, *words])
    if not rows:
        return ""
    differ = table(["", *group], rows, 1 + len(group), name="settings in which they differ")
    return paragraph("Settings in which they differ; a dash is the default:") + differ


def _flat(settings: Mapping[str, Any]) -> dict[str, str]:
    """Settings in words, those of a group each by its own name."""
    flat = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            flat |= {f"{key}: {name}": words for name, words in _flat(value).items()}
        elif words := in_words(value):
            flat[key] = words
    return flat
