"""A study with agents: what is missing is trained, what is finished is kept.

A run folder grows: `seeds/AGENT/N/` holds the policy, learning curve and metrics of one
finished seed (while it runs, its checkpoint and logs), `methods.json` the rows of the
methods. Everything is written whole or not at all, so that a study can be interrupted at
any moment and started again. The table is made from those files alone.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ..engine import Engine, run
from ..files import csv_text, json_ready, write_bytes, write_json
from ..study import Study
from .base import Progress, read_json, seed_folder

KIND = "excite study"
WORDS = ("name", "title", "inferred", "ours", "reference", "source")
"""Settings of a study that change how its table reads, not what is computed."""

_TASKS = {
    "methods": "excite.benchmark.seeds:methods_task",
    "seed": "excite.benchmark.seeds:seed_task",
}


@contextlib.contextmanager
def opened(study: Study, folder: Path) -> Iterator[None]:
    """A run folder of this study, new or begun, for one process at a time.

    Raises:
        ValueError: where the folder holds something else, or another study, or is in use.
    """
    plant = study.build_plant().description
    marker = folder / "run.json"
    if folder.exists() and not marker.is_file() and (folder.is_file() or any(folder.iterdir())):
        raise ValueError(f"{folder} exists and is no run folder; choose another name")
    if marker.is_file():
        _require_same_study(study, plant.hash, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / ".lock").open("w")
    except OSError as error:
        raise ValueError(f"{folder}: cannot be written ({error.strerror})") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ValueError(f"{folder}: another process is working on this study") from None
        write_json(folder / "study.json", study.model_dump())
        write_json(marker, {"kind": KIND, "plant": plant.to_dict(), "plant_hash": plant.hash})
        yield


def _require_same_study(study: Study, plant_hash: str, folder: Path) -> None:
    saved, marker = read_json(folder / "study.json"), read_json(folder / "run.json")
    if marker.get("kind") != KIND:
        raise ValueError(f"{folder} holds a run of another kind; choose another name")
    own = json_ready(study.model_dump())
    for agent in own["agents"].keys() ^ saved.get("agents", {}).keys():
        # An agent may be added, and trained beside those that are finished, or left out.
        own["agents"].pop(agent, None)
        saved["agents"].pop(agent, None)
    for key, value in own.items():
        if key not in WORDS and saved.get(key) != value and not (key == "plant" and ":" in value):
            raise ValueError(
                f"{folder} holds another study: its {key!r} differs; choose another name"
            )
    if marker.get("plant_hash") != plant_hash:
        raise ValueError(f"{folder} holds a study of another plant; choose another name")


def run_study(
    study: Study,
    folder: Path,
    engine: Engine,
    progress: Progress = lambda *_: None,
    on_done: Callable[[str], None] = lambda _: None,
) -> dict[str, str]:
    """Computes what the run folder lacks.

    Args:
        progress: called about once a second, in thousandths of a task.
        on_done: called with the name of every task that was finished.

    Returns:
        A sentence for every task that failed in spite of all tries.
    """
    with opened(study, folder):
        tasks, targets = _missing(study, folder), _names(study)
        before = len(targets) - len(tasks)

        def finished(name: str, result: Any) -> None:
            _keep(targets[name], folder, result)
            on_done(name)

        def tick() -> None:
            live = {n: _live(study, targets[n], folder) for n in tasks}
            done = before + sum(fraction for fraction, _ in live.values())
            text = next((text for _, text in reversed(live.values()) if text), "")
            progress(text, int(1000 * done), 1000 * len(targets))

        failures = {}
        for kind, target in _TASKS.items():
            chosen = {n: t for n, t in tasks.items() if targets[n][0] == kind}
            failures |= run(target, chosen, engine, on_done=finished, on_tick=tick)
        return failures


_Target = tuple[str, str, int]


def _names(study: Study) -> dict[str, _Target]:
    """Kind, agent and seed of every task by name."""
    names: dict[str, _Target] = {"methods": ("methods", "", 0)} if study.methods else {}
    for seed in range(study.seeds):
        names |= {f"{agent} seed {seed}": ("seed", agent, seed) for agent in study.agents}
    return names


def _missing(study: Study, folder: Path) -> dict[str, dict[str, Any]]:
    """Arguments of the tasks that are not finished; makes the seeds' folders."""
    text = None
    if ":" in study.plant:
        text = Path(study.plant.rpartition(":")[0]).read_text(encoding="utf-8")
    plant = {"text": text, "hash": study.build_plant().description.hash}
    shared = {"study": json_ready(study.model_dump()), "plant": plant}
    tasks = {}
    for name, (kind, agent, seed) in _names(study).items():
        if kind == "methods" and not (folder / "methods.json").is_file():
            tasks[name] = shared
        place = seed_folder(folder, agent, seed)
        if kind == "seed" and not (place / "metrics.json").is_file():
            place.mkdir(parents=True, exist_ok=True)
            own = {"agent": agent, "seed": seed, "folder": str(place.absolute())}
            tasks[name] = {**shared, **own}
    return tasks


def _keep(target: _Target, folder: Path, result: Any) -> None:
    """Writes what a task returned; the file that marks it as finished last."""
    kind, agent, seed = target
    if kind == "methods":
        write_json(folder / "methods.json", {"rows": result})
        return
    place = seed_folder(folder, agent, seed)
    write_bytes(place / "policy.safetensors", result["policy"])
    columns = {name: [row[name] for row in result["curve"]] for name in result["curve"][0]}
    write_bytes(place / "curve.csv", csv_text(columns).encode())
    write_json(place / "metrics.json", result["metrics"])
    for name in ("checkpoint.safetensors", "progress.json"):
        (place / name).unlink(missing_ok=True)


def _live(study: Study, target: _Target, folder: Path) -> tuple[float, str]:
    """How far a task is, and what its newest look at the policy showed."""
    kind, agent, seed = target
    if kind == "methods":
        return float((folder / "methods.json").is_file()), ""
    place = seed_folder(folder, agent, seed)
    if (place / "metrics.json").is_file():
        return 1.0, ""
    try:
        row = json.loads((place / "progress.json").read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError):
        return 0.0, ""
    errors = ", ".join(
        f"{name.removeprefix('relative_error_')} {100 * value:.3g} %"
        for name, value in row.items()
        if name.startswith("relative_error_")
    )
    text = (
        f"{agent} seed {seed}: return {row['return']:.3g}, {errors}, "
        f"violations {100 * row['violation_rate']:.0f} %"
    )
    return row["steps"] / study.build_training(agent).total_steps, text
