"""A study with agents: what is missing is trained, what is finished is kept.

A run folder grows: `seeds/AGENT/N/` holds the policy, learning curve and metrics of one
finished seed (while it runs, its checkpoint and logs), `methods.json` the rows of the
methods. Everything is written whole or not at all, so that a study can be interrupted at
any moment and started again. The table is made from those files alone.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .. import __version__
from ..engine import Engine, run
from ..files import csv_text, json_ready, write_bytes, write_json
from ..plant import AbstractPlant
from ..study import Study
from .base import Progress, fingerprint, read_json, seed_folder

KIND = "excite study"
WORDS = ("name", "title", "inferred", "ours", "reference", "source")
"""Settings of a study that change how its table reads, not what is computed."""

_Target = tuple[str, str, int]

_TASKS = {
    "methods": "excite.benchmark.base:methods_task",
    "seed": "excite.benchmark.seeds:seed_task",
}


@contextlib.contextmanager
def opened(study: Study, folder: Path) -> Iterator[tuple[AbstractPlant, str | None]]:
    """A run folder of this study, new or begun, for one process at a time.

    Yields the plant, and the source of a user's own.

    Raises:
        ValueError: where the folder holds something else, or another study, or is in use.
    """
    own = {"study.json", "run.json", ".lock"}
    marker = folder / "run.json"
    if folder.is_file() or (
        folder.exists() and not marker.is_file() and {p.name for p in folder.iterdir()} - own
    ):
        raise ValueError(f"{folder} exists and is no run folder; choose another name")
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
        plant, text = study.build_plant(), _plant_text(study)
        description = plant.description
        mark = None if text is None else hashlib.sha256(text.encode()).hexdigest()
        if marker.is_file():
            _require_same_study(study, description.hash, mark, folder)
            for target in _names(study).values():  # refused before anything is written
                _is_finished(study, plant, target, folder)
        write_json(folder / "study.json", study.model_dump())
        write_json(
            marker,
            {
                "kind": KIND,
                "excite": __version__,
                "plant": description.to_dict(),
                "plant_hash": description.hash,
                "plant_file": mark,
            },
        )
        yield plant, text


def _plant_text(study: Study) -> str | None:
    """Source of a user's own plant."""
    if ":" not in study.plant:
        return None
    return Path(study.plant.rpartition(":")[0]).read_text(encoding="utf-8")


def _require_same_study(
    study: Study, plant_hash: str, plant_file: str | None, folder: Path
) -> None:
    saved = read_json(folder / "study.json")
    marker = read_json(folder / "run.json", "kind")
    if marker["kind"] != KIND:
        raise ValueError(f"{folder} holds a run of another kind; choose another name")
    own = json_ready(study.model_dump())
    # Agents may be added to a study, or left out; every seed says itself what it was.
    for key, value in own.items():
        is_free = key in (*WORDS, "agents", "decision", "training", "gradient", "seeds")
        if not is_free and saved.get(key) != value and not (key == "plant" and ":" in value):
            raise ValueError(
                f"{folder} holds another study: its {key!r} differs; choose another name"
            )
    if (marker.get("plant_hash"), marker.get("plant_file")) != (plant_hash, plant_file):
        raise ValueError(f"{folder} holds a study of another plant; choose another name")


def _is_finished(study: Study, plant: AbstractPlant, target: _Target, folder: Path) -> bool:
    """Whether a task's results are there; ValueError where they are of another training."""
    kind, agent, seed = target
    if kind == "methods":
        return (folder / "methods.json").is_file()
    path = seed_folder(folder, agent, seed) / "metrics.json"
    if not path.is_file():
        return False
    if read_json(path, "rows", "fingerprint")["fingerprint"] != fingerprint(study, plant, agent):
        raise ValueError(
            f"{folder} holds another study: {path} is of other settings of {agent!r}; "
            "choose another name"
        )
    return True


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
    with opened(study, folder) as (plant, text):
        tasks, targets = _missing(study, plant, text, folder), _names(study)
        if tasks:  # a table of before is not that of this study
            (folder / "table.json").unlink(missing_ok=True)
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


def _names(study: Study) -> dict[str, _Target]:
    """Kind, agent and seed of every task by name."""
    names: dict[str, _Target] = {"methods": ("methods", "", 0)} if study.methods else {}
    for seed in range(study.seeds):
        names |= {f"{agent} seed {seed}": ("seed", agent, seed) for agent in study.agents}
    return names


def _missing(
    study: Study, plant: AbstractPlant, text: str | None, folder: Path
) -> dict[str, dict[str, Any]]:
    """Arguments of the tasks that are not finished; makes the seeds' folders."""
    source = {"text": text, "hash": plant.description.hash}
    shared = {"study": json_ready(study.model_dump()), "plant": source}
    tasks = {}
    for name, (kind, agent, seed) in _names(study).items():
        if _is_finished(study, plant, (kind, agent, seed), folder):
            continue
        own = {}
        if kind == "seed":
            place = seed_folder(folder, agent, seed)
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
    try:  # it is there to be looked at, and may be anything
        row = read_json(place / "progress.json")
        total = study.agent(agent).total_steps(study.num_steps)
        return row["steps"] / total, _looks(agent, seed, row)
    except (ValueError, KeyError, TypeError, AttributeError):
        return 0.0, ""


def _looks(agent: str, seed: int, row: dict[str, float]) -> str:
    errors = ", ".join(
        f"{name.removeprefix('relative_error_')} {100 * value:.3g} %"
        for name, value in row.items()
        if name.startswith("relative_error_")
    )
    return (
        f"{agent} seed {seed}: return {row['return']:.3g}, {errors}, "
        f"violations {100 * row['violation_rate']:.0f} %"
    )
