"""The study's own methods: all of their rows, and the run folder of a study without agents."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .. import __version__
from ..files import new_run_folder, write_json
from ..study import Study
from .base import Progress, evaluate_method, num_chunks, unpacked


def run_benchmark(study: Study, progress: Progress = lambda *_: None) -> list[dict[str, Any]]:
    """Rows of the study's methods in order, each with all estimators."""
    plant = study.build_plant()
    methods, rows = study.build_methods(plant), []
    parts = num_chunks(study)
    for m, (name, excitation) in enumerate(methods.items()):

        def in_method(c: int, name: str = name, before: int = m * parts) -> None:
            progress(name, before + c, len(methods) * parts)

        rows += evaluate_method(study, plant, name, excitation, in_method)[0]
    progress("done", len(methods) * parts, len(methods) * parts)
    return rows


def methods_task(study: Mapping[str, Any], plant: Mapping[str, Any]) -> dict[str, Any]:
    """Rows of a study's own methods; what a worker is called for."""
    with unpacked(study, plant) as (chosen, _):
        return {"rows": run_benchmark(chosen)}


def write_benchmark(
    study: Study,
    rows: list[dict[str, Any]],
    shown: Mapping[str, bytes],
    path: Path,
    overwrite: bool = False,
    command: str = "",
) -> None:
    """Leaves a run folder: the study, its rows as JSON, and what people look at.

    Args:
        shown: tables, figures and episodes, ready made, by file name.
        command: that made it, for those who want to do it again.

    Raises:
        ValueError: where `path` holds something else, or a run and not `overwrite`.
    """
    with new_run_folder(path, overwrite) as folder:
        for name, content in shown.items():
            (folder / name).write_bytes(content)
        write_json(folder / "table.json", {"rows": rows})
        plant = study.build_plant().description
        write_json(folder / "study.json", study.model_dump())
        about = {"kind": "excite benchmark", "excite": __version__, "command": command}
        write_json(folder / "run.json", {**about, "plant": plant.to_dict()})
