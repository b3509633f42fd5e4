"""The run folder: its runs are listed, and only listed files are served.

A name from a browser is looked up among the names found by walking the folder; it never
becomes a path. Links are not followed.
"""

from __future__ import annotations

import asyncio
import contextlib
import csv
import json
import math
import os
from collections.abc import Collection, Iterator, Mapping
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from ..description import PlantDescription
from ..files import folder_word, is_locked, json_ready
from ..record import RECORD_KIND
from ..report.answer import answered, best_columns
from ..report.frontier import QUANTITY, frontier
from ..report.key_figures import of_experiment, of_identification, of_study, of_training
from ..report.rows import EstimateSummary, StudyFacts
from ..report.sections.campaign import known_table, outcome, rounds_table
from ..report.study_table import (
    NUM_LABELS,
    StudyTable,
    footnotes,
    has_gain,
    information_of,
    violations_cell,
)
from .requests import RefusedError, without_folders

_TYPES = {
    ".png": "image/png",
    ".csv": "text/csv",
    ".json": "application/json",
    ".md": "text/plain",
    ".tex": "text/plain",
    ".safetensors": "application/octet-stream",
}
_DEPTH, _MAX_RUNS, _MAX_CURVES, _MAX_TEXT = 4, 500, 256, 4 * 2**20
_RESULTS = ("run.json", "study.json", "table.json", "estimate.json", "campaign.json")


def routes(folder: Path) -> list[Route]:
    """Routes that show the run folder."""
    looking, last = asyncio.Lock(), 0
    latest = (0, b"")  # the last request that it answers, and the answer

    def look() -> bytes:
        every = sorted(found(folder).items())
        return bytes(JSONResponse({"runs": [_summary(name, run) for name, run in every]}).body)

    async def listed(request: Request) -> Response:
        """The list as it is after the request came: one look answers all that came before it."""
        nonlocal latest, last
        del request
        own = last = last + 1
        async with looking:
            if latest[0] < own:
                answered = last
                latest = (answered, await asyncio.to_thread(look))
        return Response(latest[1], media_type="application/json")

    def shown(request: Request) -> JSONResponse:
        return JSONResponse(_content(run_of(folder, request)))

    def file(request: Request) -> FileResponse:
        path = files_of(run_of(folder, request)).get(request.query_params.get("file", ""))
        if path is None:
            raise RefusedError(404, "this run has no such file")
        return FileResponse(path, media_type=_TYPES[path.suffix], filename=path.name)

    return [
        Route("/api/runs", listed),
        Route("/api/run", shown),
        Route("/api/run/file", file),
    ]


def found(folder: Path) -> dict[str, Path]:
    """Every run below the run folder, by its path in it: folders, and records outside of them."""
    runs: dict[str, Path] = {}
    for place, folders, files in os.walk(folder, followlinks=False):
        path = Path(place)
        if "run.json" in files:
            own = [path]
            folders.clear()
        else:
            own = [path / file for file in sorted(files) if _is_record(path / file, files)]
        for run in own:
            name = run.relative_to(folder).as_posix()
            if _is_text(name) and len(runs) < _MAX_RUNS:
                runs[name] = run
        folders[:] = [f for f in sorted(folders) if f[0] != "." and not (path / f).is_symlink()]
        if len(path.relative_to(folder).parts) >= _DEPTH:
            folders.clear()
    return runs


def _is_record(path: Path, beside: Collection[str]) -> bool:
    """Whether a file is a record with its sidecar, and neither is a link."""
    sidecar = path.with_suffix(".json")
    is_named = path.suffix == ".csv" and sidecar.name in beside
    return is_named and not path.is_symlink() and _is_of_record(path, _written(sidecar))


@lru_cache(8 * _MAX_RUNS)
def _is_of_record(path: Path, written: object) -> bool:
    """Whether the sidecar of a file is that of a record, read again when it was written."""
    del written
    return _marker(path).get("kind") == RECORD_KIND


def _written(*paths: Path) -> tuple[tuple[int, ...], ...]:
    """What changes when one of some files is written."""
    found = list[tuple[int, ...]]()
    for path in paths:
        with contextlib.suppress(OSError):  # there is none, or it was removed in the meantime
            seen = path.lstat()
            found.append((seen.st_mtime_ns, seen.st_size, seen.st_ino))
    return tuple(found)


def _is_text(name: str) -> bool:
    """Whether a name can be sent; bytes that are no text come as lone surrogates."""
    return name.encode(errors="ignore").decode() == name


def run_of(folder: Path, request: Request) -> Path:
    """The run that a request names."""
    return run_named(found(folder), request.query_params.get("name"))


def run_named(runs: Mapping[str, Path], name: object) -> Path:
    """The run of a name from a browser among those that were found."""
    if not isinstance(name, str) or name not in runs:
        raise RefusedError(404, "the run folder has no such run")
    return runs[name]


def files_of(run: Path) -> dict[str, Path]:
    """Files of a run that are served, by name, also those of finished seeds."""
    if run.is_file():
        return {path.name: path for path in (run.with_suffix(".json"), run)}

    def each() -> Iterator[Path]:
        yield from run.iterdir()
        yield from run.glob("seeds/*/*/policy.safetensors")

    named = {path.relative_to(run).as_posix(): path for path in sorted(each())}
    return {
        name: path
        for name, path in named.items()
        if path.suffix in _TYPES and _is_text(name) and _is_inside(path, run)
    }


def _is_inside(path: Path, run: Path) -> bool:
    """Whether this is a file in the run's folder, not reached by a link."""
    inside = not path.is_symlink() and path.resolve().is_relative_to(run.resolve())
    return inside and path.is_file()


def _text(run: Path, name: str) -> str:
    """Content of a file of a run; empty where it is missing, damaged, too long or a link."""
    path = run / name
    try:
        if not _is_inside(path, run) or path.stat().st_size > _MAX_TEXT:
            return ""
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""


def _json(run: Path, name: str) -> dict[str, object]:
    """Content of a JSON file of a run; empty where there is none."""
    try:
        content = json.loads(_text(run, name))
        json.dumps(content, ensure_ascii=False, allow_nan=False).encode()  # as it will be sent
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _summary(name: str, run: Path) -> dict[str, object]:
    written = _written(run.with_suffix(".json"), *(run / file for file in _RESULTS))
    return {"name": name, "changed": _changed(run), **_found_in(run, written)}


@lru_cache(2 * _MAX_RUNS)
def _found_in(run: Path, written: object) -> dict[str, object]:
    """What the result files of a run say, read again when one was written."""
    del written
    marker, study, kind = _marker(run), _json(run, "study.json"), _kind(run)
    plant = marker.get("plant")
    is_finished = bool(_json(run, "campaign.json").get("reason")) or any(
        _is_inside(run / f, run) for f in ("table.json", "estimate.json")
    )
    if kind == "experiment":
        is_finished = marker.get("ended", "simulated") is not None
    return {
        "kind": kind,
        "plant": str(plant.get("name", "")) if isinstance(plant, dict) else "",
        "command": without_folders(str(marker.get("command") or "")),
        "title": str(study.get("title") or study.get("name") or ""),
        "key_figures": _key_figures(run, kind),
        "is_finished": is_finished,
    }


def _marker(run: Path) -> dict[str, object]:
    """What says of which kind a run is: its `run.json`, or the sidecar of a record."""
    if run.is_dir():
        return _json(run, "run.json")
    return _json(run.parent, run.with_suffix(".json").name)


def _kind(run: Path) -> str:
    """Experiment, identification, campaign, study, or training: what `excite train` made."""
    marker = _marker(run)
    if marker.get("kind") == RECORD_KIND:
        return "experiment"
    is_training = str(marker.get("command", "")).startswith("excite train ")
    return "training" if is_training else str(marker.get("kind", "")).removeprefix("excite ")


def _key_figures(run: Path, kind: str) -> str:
    """What a run found, in one line; empty where it is not finished or damaged."""
    with contextlib.suppress(LookupError, TypeError, AttributeError, ArithmeticError, ValueError):
        if kind == "experiment":
            return of_experiment(_marker(run))
        if kind == "identification":
            return of_identification(EstimateSummary.of(_json(run, "estimate.json")))
        if kind == "campaign":
            return outcome(_json(run, "campaign.json"))
        if kind in ("study", "training"):
            table = table_of(run)
            return of_training(table) if kind == "training" else of_study(table)
    return ""


def table_of(run: Path) -> StudyTable:
    """The table of a finished study; ValueError where there is none, or it is damaged."""
    study = StudyFacts.model_validate(_json(run, "study.json"))
    return StudyTable.model_validate({**_json(run, "table.json"), "study": study})


def estimate_of(run: Path) -> EstimateSummary | None:
    """What an identification found, or the last one of a campaign; None where there is none."""
    for file in ("estimate.json", "estimate/estimate.json"):
        with contextlib.suppress(ValueError):
            return EstimateSummary.of(_json(run, file))
    return None


def plant_of_run(run: Path) -> PlantDescription | None:
    """The plant of a run; None where its description is missing or damaged."""
    plant: Any = _marker(run).get("plant")
    with contextlib.suppress(LookupError, TypeError, AttributeError, ArithmeticError, ValueError):
        return PlantDescription.from_dict(plant)
    return None


def _changed(run: Path) -> str:
    """When the newest file of a run was written, in UTC; empty where there is none."""
    times = list[float]()
    for path in run.glob("[!.]*") if run.is_dir() else [run]:
        with contextlib.suppress(OSError):  # removed in the meantime
            times.append(path.lstat().st_mtime)
    if not times:
        return ""
    return datetime.fromtimestamp(max(times), UTC).isoformat(timespec="seconds")


def _content(run: Path) -> dict[str, object]:
    """Content of a run for the page: its table or estimate, and its files."""
    files = files_of(run)
    return {
        **_summary(run.name, run),
        **_table(_text(run, "table.md")),
        "study": _study(run),
        "estimate": _json(run, "estimate.json"),
        "campaign": _campaign(run),
        "curves": _curves(run),
        "figures": [name for name in files if name.endswith(".png")],
        "files": [name for name in files if not name.endswith(".png")],
    }


def _study(run: Path) -> dict[str, object]:
    """Answer, frontier and table by estimator of a study; empty where it is not finished."""
    try:
        table = table_of(run)
    except ValueError:
        return {}
    answer, first = answered(table.rows, table.study, {}), table.only(table.rows[0].estimator)
    best, in_nats = frontier(table.rows), has_gain(table.rows)
    points = [
        {
            "method": row.method,
            "told": information_of(row, in_nats),
            "rate": row.violation_rate.estimate,
            "interval": row.violation_rate.ci95,
            "violations": violations_cell(row),
            "is_best": row.method in best,
        }
        for row in first.rows
    ]
    estimators = dict.fromkeys(row.estimator for row in table.rows)
    return {
        "sentences": answer.sentences[:2],  # the third, on a search, is in the report
        "estimator": answer.rows[0].estimator,
        "tables": {name: _methods(table.only(name)) for name in estimators},
        "points": json_ready(points),
        "quantity": {"name": "gain in nats" if in_nats else "log det", "about": QUANTITY[in_nats]},
        "notes": footnotes(table.study, table.rows),
    }


def _methods(table: StudyTable) -> dict[str, object]:
    """The table of one estimator: a row a method, with the columns in which it is best.

    Violations come first, where a narrow window shows them.
    """
    (header, cells), best = table.cells(), best_columns(table)
    safety = header.index("violations (95 %)")
    order = [safety, *(i for i in range(NUM_LABELS, len(header)) if i != safety)]
    rows = []
    for method, estimator, *numbers in cells:
        own = [numbers[i - NUM_LABELS] for i in order]
        is_own = estimator == table.rows[0].estimator  # or it is as published
        columns = sorted(best[method]) if is_own else []
        name = method if is_own else f"{method}, {estimator}"
        rows.append({"cells": [name, *own], "best": [order.index(i) + 1 for i in columns]})
    return {"header": [header[0], *(header[i] for i in order)], "rows": rows}


def _campaign(run: Path) -> dict[str, object]:
    """Tables of a campaign: what is known, and its rounds; empty where there is none."""
    content: dict[str, Any] = _json(run, "campaign.json")
    marker: dict[str, Any] = _json(run, "run.json")
    try:
        plant = PlantDescription.from_dict(marker["plant"])
        tables = known_table(plant, content), rounds_table(content["rounds"])
    except (LookupError, TypeError, AttributeError, ArithmeticError, ValueError):
        return {}
    is_playing = not content.get("reason") and is_locked(run / ".lock")
    known, rounds = ({"header": header, "rows": rows} for header, rows in tables)
    return {
        "known": known,
        "rounds": rounds,
        "now": _now_played(run, content) if is_playing else "",
        "interrupted": str(content.get("interrupted", "")),
        "told": str(content.get("reason") or content.get("interrupted") or ""),
    }


def _now_played(run: Path, content: Mapping[str, Any]) -> str:
    """What a campaign does whose process works in its folder."""
    told, index = content["rounds"], len(content["rounds"]) + 1
    last = max((i for i in range(1, index + 1) if (run / f"round-{i:02}.csv").is_file()), default=1)
    samples = len(_text(run, f"round-{last:02}.csv").splitlines()) - 2  # without names and start
    samples -= sum(int(r["num_samples"]) for r in told[last - 1 :])  # of a round that goes on
    if samples < 1:
        return f"Round {index} is prepared."
    playing = content.get("playing") or "the last one begun"
    return f"Round {index} ({playing}): {samples} sample{'s' * (samples != 1)} so far."


def _table(text: str) -> dict[str, object]:
    """Header, rows and notes of the first table of a Markdown text."""
    lines = text.splitlines()
    first = next((i for i, line in enumerate(lines) if line.startswith("|")), len(lines))
    end = next((i for i in range(first, len(lines)) if not lines[i].startswith("|")), len(lines))
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[first:end]]
    notes = [line for line in lines[end:] if line and not line.startswith(("|", "#"))]
    return {"header": cells[0] if cells else [], "rows": cells[2:], "notes": notes}


def _curves(run: Path) -> list[dict[str, object]]:
    """Learning curves of the finished seeds; those of bounds are marked."""
    bounds = _json(run, "table.json").get("bound_curves")
    bounds = bounds if isinstance(bounds, list) else []
    agents = _json(run, "study.json").get("agents")
    names = {folder_word(name): name for name in agents} if isinstance(agents, dict) else {}
    curves = []
    for path in sorted(run.glob("seeds/*/*/curve.csv"))[:_MAX_CURVES]:
        if _is_inside(path, run):
            agent = names.get(path.parts[-3], path.parts[-3])
            curves.append({"agent": agent, "is_bound": agent in bounds, "columns": curve_in(path)})
    return curves


def curve_in(path: Path) -> dict[str, list[float]]:
    """Columns of a learning curve; empty where it cannot be read."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        columns = {name: [float(row[name]) for row in rows] for name in (rows[0] if rows else {})}
    except (OSError, ValueError, TypeError):
        return {}
    return {n: values for n, values in columns.items() if all(map(math.isfinite, values))}
