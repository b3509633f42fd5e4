"""Runs of the run folder beside each other: estimates, methods and signals; the signals of one."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from pathlib import Path

from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

from ..description import PlantDescription
from ..files import json_ready
from ..record import Record
from ..record.figure import kept_samples
from ..report.estimates import beside
from ..report.rows import EstimateSummary
from ..report.sections.elements import record_in
from ..report.study_table import StudyTable, common_table
from .events import ShownTable
from .requests import RefusedError
from .runs import estimate_of, files_of, found, plant_of_run, run_named, table_of
from .sessions import MAX_KEPT, Session
from .shown import shown_plant, shown_table

_MAX_RUNS, _MAX_EXPERIMENTS = 12, 12
_MAX_POINTS = 20_000  # of a record; longer ones show the extremes of each section
_RECORD = re.compile(r"(record(_\d+)?|round-\d+)\.csv")


def routes(folder: Path) -> list[Route]:
    """The routes that compare runs, and results of a browser."""

    def compared(request: Request) -> JSONResponse:
        names = list(dict.fromkeys(request.query_params.getlist("name")))
        if not 1 <= len(names) <= _MAX_RUNS:
            raise RefusedError(400, f"one to {_MAX_RUNS} runs can be compared: got {len(names)}")
        every = found(folder)
        return JSONResponse(_compared({name: run_named(every, name) for name in names}))

    def beside_each_other(request: Request) -> JSONResponse:
        names = list(dict.fromkeys(request.query_params.getlist("name")))
        session: Session = request.state.session
        found = dict[str, EstimateSummary]()
        for name in names[-MAX_KEPT:]:
            with contextlib.suppress(RefusedError), session.using(name, "result") as place:
                own = estimate_of(place / "run")
                if own is not None:
                    title = f"{len(found) + 1}: {', '.join(own.files)}, {own.plant}"
                    found[title] = own
        return JSONResponse(shown_table("Identified in this tab", beside(found)))

    return [
        Route("/api/runs/compared", compared),
        Route("/api/results/compared", beside_each_other),
    ]


def _compared(runs: Mapping[str, Path]) -> dict[str, object]:
    """Tables, plots and sentences on what cannot be compared."""
    estimates = {name: own for name, run in runs.items() if (own := estimate_of(run))}
    studies = dict[str, StudyTable]()
    for name, run in runs.items():
        with contextlib.suppress(ValueError):  # no study, or not finished
            studies[name] = table_of(run)
    tables, notes = list[ShownTable](), list[str]()
    if len(estimates) > 1:
        tables.append(shown_table("Estimates with 95 % intervals", beside(estimates)))
    if len(studies) > 1:
        common = common_table(studies) if _are_alike(studies) else None
        if common is None:
            notes.append(f"{', '.join(studies)}: no method and estimator in common.")
        else:
            tables.append(shown_table("Methods in several studies", common))
    experiments, unlike = _experiments(runs)
    notes += [f"{name}: other inputs or outputs, which are not drawn." for name in unlike]
    if not tables and not experiments:
        notes.append("These runs have nothing in common that can be compared.")
    return {"tables": tables, "notes": notes, "experiments": experiments}


def _are_alike(studies: Mapping[str, StudyTable]) -> bool:
    """Whether the rows of studies have the same columns."""
    firsts = [table.rows[0] for table in studies.values()]
    kinds = {(*r.parameters, r.max_abs_output.output, r.max_abs_output.unit) for r in firsts}
    return len(kinds) == 1


def _experiments(runs: Mapping[str, Path]) -> tuple[dict[str, object] | None, list[str]]:
    """Signals of all experiments with the inputs and outputs of the first; which runs have others.

    None where not all are of one run, and fewer than two have experiments that are alike.
    """
    first: PlantDescription | None = None
    drawn, unlike, sources = list[dict[str, object]](), list[str](), set[str]()
    for name, run in runs.items():
        plant = plant_of_run(run)
        files = [path for file, path in files_of(run).items() if _RECORD.fullmatch(file)]
        files = [run] if run.is_file() else files
        if plant is None or not files:
            continue
        first = first or plant
        if _signals(plant) != _signals(first):
            unlike.append(name)
            continue
        for path in files:
            with contextlib.suppress(ValueError):  # it is damaged
                title = name if len(files) == 1 else f"{name}: {path.stem}"
                drawn.append({"name": title, **_traces(record_in(path, plant))})
                sources.add(name)
    if first is None or len(sources) < min(2, len(runs)):
        return None, []
    return {
        "plant": shown_plant(first),
        "runs": drawn[:_MAX_EXPERIMENTS],
        "total": len(drawn),
    }, unlike


def _signals(plant: PlantDescription) -> list[tuple[str, str]]:
    return [(part.name, part.unit) for part in (*plant.inputs, *plant.outputs)]


def _traces(record: Record) -> dict[str, object]:
    """Inputs and measured outputs since the start of a record."""
    kept = kept_samples([*record.inputs.T, *record.outputs.T], _MAX_POINTS)
    time = record.time[kept] - record.time[0]
    signals = {"time": time, "inputs": record.inputs[kept], "outputs": record.outputs[kept]}
    return json_ready(signals)
