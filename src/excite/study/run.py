"""`run_study`: computes what is missing in a run folder and writes the tables.

In the run folder, `seeds/AGENT/N/` holds the policy, learning curve and metrics of one
finished seed (while it runs, its checkpoint and logs), and `methods.json` the rows of the
methods. Every file is written completely or not at all, so that a study can be interrupted
at any time and resumed. The table is made from these files alone.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import json
import os
import shutil
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax

from .. import __version__
from ..description import path_from, require_whole
from ..files import (
    csv_text,
    holds_only,
    json_ready,
    locked_folder,
    new_run_folder,
    require_free_run_folder,
    write_bytes,
    write_json,
)
from ..plant import AbstractPlant
from ..policy import POLICY_ENDING, read_policy
from ..progress import SHOWN, Progress
from ..record.figure import image
from ..record.read import SIGNAL_ENDINGS
from ..report.frontier import frontier_figure, lengths_figure
from ..report.rows import CountsBySeed, Rows
from ..report.study_figures import agents_figure, curves_figure
from ..report.study_table import StudyTable, differences_csv
from .catalogue import study_path
from .cluster import dask_engine
from .engine import Engine, Stage, local_engine, run
from .example_episodes import episodes_data, example_episodes
from .folder import advice, agent_settings, fingerprint, read_json, seed_folder, study_of
from .methods import compared, method_rows
from .pool import num_cores
from .progress import FILES as PROGRESS_FILES
from .progress import read_phase, read_progress, remove_progress
from .spec import Study, read_study
from .table import best_seeds, learning_curves, study_table, too_near
from .tasks import clairvoyant_task, methods_task, safety_task, seed_task
from .worker import OF_PPO

KIND = "excite study"
FREE = {"name", "title", "note", "inferred", "ours", "reference", "source"}
FREE |= {"agents", "decision", "training", "gradient", "seeds", "safety_episodes"}
"""Settings that may change when a study is resumed; each seed stores its settings."""

_Target = tuple[str, str, int]

_TASKS = {
    "methods": methods_task,
    "clairvoyant": clairvoyant_task,
    "seed": seed_task,
    "safety": safety_task,
}
_MARKERS = ("study.json", "run.json")
_NO_RESULTS = (*_MARKERS, *PROGRESS_FILES)  # a new folder with nothing else is removed


class StudyFailedError(RuntimeError):
    """Tasks of a study failed after all tries; the message lists them with the reasons."""


def run_study(
    study: Study | str | Path,
    out: str | Path | None = None,
    *,
    episodes: int | None = None,
    seed: int | None = None,
    estimators: str | Sequence[str] | None = None,
    engine: Literal["local", "dask"] = "local",
    workers: int | None = None,
    address: str | None = None,
    overwrite: bool = False,
    progress: Progress = SHOWN,
    on_done: Callable[[str], None] = lambda _: None,
    on_wait: Callable[[], None] = lambda: None,
    command: str = "",
) -> StudyTable:
    """Compares the methods of a study, and trains its agents; rerun it to resume.

        >>> import excite as ex
        >>> table = ex.run_study("nls", episodes=4)
        >>> table.rows[0].method, table.rows[0].evaluations
        ('random', 4)

    Args:
        study: a study, a file, or the name of a shipped study.
        out: run folder; a study without agents needs none.
        episodes: replaces the study's.
        seed: replaces the study's.
        estimators: replace the study's: their names, or these with commas between.
        engine: processes of this machine, or a Dask cluster.
        workers: processes of the local engine, where agents are trained or signals designed;
            default one per core.
        address: of the cluster's scheduler, tcp://HOST:PORT.
        overwrite: whether a run in `out` is replaced instead of resumed.
        progress: called with what is being computed, how much is done, and the total.
        on_done: called with the name of every task that was finished.
        on_wait: called when the cluster has no worker yet.
        command: stored in the run folder, to repeat the run.

    Raises:
        ValueError: for a study, an option or a folder that cannot be used.
        StudyFailedError: where tasks failed; finished tasks are kept.
    """
    chosen = study if isinstance(study, Study) else read_study(study_path(study))
    chosen = chosen.changed(episodes=episodes, seed=seed, estimators=estimators)
    machine = _engine(engine, workers, address, on_wait)
    what = "agents to train" if chosen.agents else "signals to design" if chosen.clairvoyant else ""
    if workers is not None and not what:
        raise ValueError(
            f"the study {chosen.name!r} has nothing to train or design: it needs no workers"
        )
    if out is None:
        if what:
            raise ValueError(f"the study {chosen.name!r} has {what}: it needs a run folder, out")
        if engine == "dask":
            raise ValueError("the engine 'dask' needs a run folder, out")
        table = compared(chosen, progress)
        on_done("methods")
        return table
    folder = path_from("out", out)
    place: contextlib.AbstractContextManager[Path] = contextlib.nullcontext(folder)
    if overwrite:
        require_free_run_folder(folder, overwrite, KIND)
    if not what and engine == "local":
        machine = None
        if overwrite or not folder.exists():  # the folder appears when it is complete
            place = new_run_folder(folder, overwrite, KIND)
    replaced = overwrite and machine is not None
    if machine is not None and engine == "local":
        _require_trainer(chosen, None if replaced else folder)
    elif machine is not None and replaced:
        machine(1).close(is_done=True)  # the scheduler answers
    with place as where:
        failures = run_tasks(chosen, where, machine, progress, on_done, command, replaced)
        if failures:
            raise _failed(failures, folder)
        return write_table(chosen, where)


def _engine(
    engine: Literal["local", "dask"],
    workers: int | None,
    address: str | None,
    on_wait: Callable[[], None],
) -> Engine:
    if engine == "dask":
        if address is None:
            raise ValueError(
                "the engine 'dask' needs the address of its scheduler, tcp://HOST:PORT"
            )
        if workers is not None:
            raise ValueError("workers are for the engine 'local', not for a Dask cluster")
        return dask_engine(address, on_wait)
    if address is not None:
        raise ValueError("the address is for the engine 'dask'")
    if workers is not None:
        require_whole("workers", workers, 1)
    cache = jax.config.values["jax_compilation_cache_dir"]
    return local_engine(workers or num_cores(), Path(cache) if cache else None)


def _require_trainer(study: Study, folder: Path | None) -> None:
    """Raises ValueError where seeds must be trained and a library is missing.

    Args:
        folder: with the seeds that are finished; None if all must be trained.
    """
    seeds = [
        (name, seed)
        for name, agent in study.agents.items()
        for seed in range(study.seeds)
        if agent.method == "ppo"
    ]
    if not seeds or (
        folder is not None
        and all((seed_folder(folder, *seed) / "metrics.json").is_file() for seed in seeds)
    ):
        return
    missing = [name for name in OF_PPO if importlib.util.find_spec(name) is None]
    if missing:
        raise ValueError(f"training needs {', '.join(missing)}: pip install 'excite[ppo]'")


def _failed(failures: Mapping[str, Exception], folder: Path) -> Exception:
    """One error for all failed tasks; ValueError where all are mistakes of the user."""
    names: dict[str, list[str]] = {}
    for name, error in failures.items():
        names.setdefault(str(error), []).append(name)
    reasons = "; ".join(f"{', '.join(some)}: {reason}" for reason, some in names.items())
    is_mistake = all(isinstance(error, ValueError) for error in failures.values())
    kept = f"what is finished is kept in {folder}; rerun the same command to resume"
    return (ValueError if is_mistake else StudyFailedError)(
        f"{len(failures)} task{'s' * (len(failures) > 1)} failed ({reasons}); "
        f"{kept if folder.exists() else 'nothing is finished'}"
    )


def write_table(study: Study, folder: Path) -> StudyTable:
    """Writes the table and the figures of a finished study into its run folder."""
    table, plant = study_table(folder), study.build_plant().description
    rows, title = table.rows, table.study.heading
    seeds = best_seeds(study, folder)
    episodes = example_episodes(study, folder, seeds)
    content = json.dumps(json_ready(episodes_data(plant, episodes)), ensure_ascii=False)
    files = {
        "table.md": table.markdown().encode(),
        "table.csv": table.csv().encode(),
        "table.tex": table.latex().encode(),
        "errors.png": image(table.plot(), "png"),
        "episodes.json": content.encode(),
    }
    if study.clairvoyant is not None:
        files["frontier.png"] = image(frontier_figure(rows, title), "png")
    if study.lengths:
        files["lengths.png"] = image(lengths_figure(rows, title), "png")
    if study.agents:
        bounds = study.bound_curves()
        curves = curves_figure(plant, learning_curves(study, folder), title, bounds)
        played = agents_figure(plant, {agent: episodes[agent] for agent in seeds}, title)
        files["differences.csv"] = differences_csv(table.differences).encode()
        for sentence in too_near(study, folder):
            warnings.warn(sentence, stacklevel=2)
        files |= {"curves.png": image(curves, "png"), "episodes.png": image(played, "png")}
        table = table.model_copy(update={"best_seeds": seeds, "bound_curves": tuple(bounds)})
    for name, data in files.items():
        write_bytes(folder / name, data)
    write_json(folder / "table.json", table.data())
    return table


@contextlib.contextmanager
def opened(
    study: Study, folder: Path, command: str = "", overwrite: bool = False
) -> Iterator[dict[str, dict[str, Any]]]:
    """A new or existing run folder of this study, for one process at a time.

    Yields the arguments of each unfinished task by its name.

    Args:
        overwrite: whether the run in the folder is removed first.

    Raises:
        ValueError: where the folder is not a run folder, holds another study, or is in use.
    """
    every = _checkpoint_seconds()
    is_begun = folder.is_dir() and bool({p.name for p in folder.iterdir()} - {*_MARKERS, ".lock"})
    if is_begun and not any((folder / name).is_file() for name in _MARKERS):
        raise ValueError(f"{folder} exists and is no run folder; choose another name")
    with locked_folder(folder, "this study", _NO_RESULTS):
        plant, text = study.build_plant(), _plant_text(study)
        marker = {**_marker(study, plant, text), "command": command}
        if overwrite:
            _clear(folder)
        elif is_begun:
            _require_same_study(study, marker, folder)
        tasks = _missing(study, plant, folder, every)
        # All checks are done.
        write_json(folder / "study.json", study.model_dump())
        write_json(folder / "run.json", marker)
        source = {"text": text, "hash": plant.description.hash}
        shared = {"study": json_ready(study.model_dump()), "plant": source}
        for own in tasks.values():
            if "folder" in own:
                Path(own["folder"]).mkdir(parents=True, exist_ok=True)
        yield {name: {**shared, **own} for name, own in tasks.items()}


def _clear(folder: Path) -> None:
    """Removes everything in a locked run folder but the lock."""
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != ".lock":
            path.unlink()


def _checkpoint_seconds() -> float:
    """Least time between two checkpoints of a seed."""
    text = os.environ.get("EXCITE_CHECKPOINT_SECONDS", "20")
    with contextlib.suppress(ValueError):
        if (seconds := float(text)) >= 0:
            return seconds
    raise ValueError(f"EXCITE_CHECKPOINT_SECONDS must be zero or a positive number: got {text!r}")


def _marker(study: Study, plant: AbstractPlant, text: str | None) -> dict[str, Any]:
    """Content of `run.json`, which identifies the run."""
    return {
        "kind": KIND,
        "excite": __version__,
        "plant": plant.description.to_dict(),
        "plant_hash": plant.description.hash,
        "plant_file": None if text is None else hashlib.sha256(text.encode()).hexdigest(),
        "policies": {
            name: origin.get("policy_hash") or origin["signal_hash"]
            for name, origin in study.origins(plant).items()
        },
    }


def _plant_text(study: Study) -> str | None:
    """Source of a user-defined plant."""
    if ":" not in study.plant:
        return None
    return Path(study.plant.rpartition(":")[0]).read_text(encoding="utf-8")


def _require_same_study(study: Study, marker: Mapping[str, Any], folder: Path) -> None:
    """Raises ValueError where the folder is of another study; deleted files are allowed."""
    if (folder / "study.json").is_file():
        own, saved = _compared(study), _compared(study_of(folder))
        for key in own:
            if saved[key] != own[key]:
                raise ValueError(
                    f"{folder} holds another study: its {key!r} differs; choose another name"
                )
    if (folder / "run.json").is_file():
        saved = read_json(folder / "run.json", "kind", "plant_hash", "plant_file")
        if saved["kind"] != KIND:
            raise ValueError(f"{folder} holds a run of another kind; choose another name")
        for key, what in (("plant_hash", "plant"), ("plant_file", "plant"), ("policies", "policy")):
            if saved.get(key, marker[key]) != marker[key]:
                raise ValueError(f"{folder} holds a study of another {what}; choose another name")


def _compared(study: Study) -> dict[str, Any]:
    """Settings that determine the results, without the paths of plant and policies."""
    settings = json_ready(study.model_dump(exclude=FREE))
    settings["plant"] = study.plant.rpartition(":")[2]
    for method in settings["methods"].values():
        if method["excitation"].endswith((POLICY_ENDING, *SIGNAL_ENDINGS)):
            method["excitation"] = Path(method["excitation"]).name
    return settings


def _is_finished(study: Study, plant: AbstractPlant, target: _Target, folder: Path) -> bool:
    """Whether a task's results exist; ValueError where they are of another training."""
    kind, agent, seed = target
    if kind == "safety":
        place = seed_folder(folder, agent, seed)
        if not all((place / name).is_file() for name in ("metrics.json", "safety.json")):
            return False
        counts = CountsBySeed.read(place / "safety.json", advice(place / "safety.json"))
        return counts.evaluations == study.safety_episodes
    if kind != "seed":
        return (folder / f"{kind}.json").is_file()
    path = seed_folder(folder, agent, seed) / "metrics.json"
    if not path.is_file():
        return False
    if read_json(path, "rows", "fingerprint")["fingerprint"] != fingerprint(study, plant, agent):
        raise ValueError(
            f"{folder} holds another study: {path} is of other settings of {agent!r}"
            f"{_differing(study, plant, agent, path)}; choose another name"
        )
    return True


def _differing(study: Study, plant: AbstractPlant, agent: str, metrics: Path) -> str:
    """Names of the settings that differ, according to the seed's policy."""

    def flat(settings: Mapping[str, Any]) -> dict[str, Any]:
        parts = (settings, settings.get("decision", {}), settings.get("training", {}))
        return {k: v for part in parts for k, v in part.items() if v not in parts[1:]}

    try:
        before = flat(read_policy(metrics.with_name("policy.safetensors")).provenance)
    except (ValueError, AttributeError):
        return ""
    own = flat(json_ready(agent_settings(study, plant, agent)))
    names = [name for name, value in own.items() if name in before and before[name] != value]
    return f" ({', '.join(names)})" if names else ""


def run_tasks(
    study: Study,
    folder: Path,
    engine: Engine | None,
    progress: Progress = SHOWN,
    on_done: Callable[[str], None] = lambda _: None,
    command: str = "",
    overwrite: bool = False,
) -> dict[str, Exception]:
    """Computes what is missing in the run folder.

    Args:
        engine: None for this process, which can evaluate methods only.
        progress: called about once a second, in thousandths of a task.
        on_done: called with the name of every task that was finished.
        command: that runs it, stored in `run.json`.
        overwrite: whether the run in the folder is removed first.

    Returns:
        The error of each task that failed after all tries.
    """
    is_new = not folder.exists()
    with opened(study, folder, command, overwrite) as tasks:
        targets = _names(study)
        if tasks:  # an earlier table is outdated
            (folder / "table.json").unlink(missing_ok=True)
        before = len(targets) - len(tasks)
        if engine is None:
            if "methods" in tasks:
                rows = method_rows(study, progress)
                _keep(targets["methods"], folder, Rows(rows=tuple(rows)).data())
                on_done("methods")
            return {}

        def finished(name: str, result: object) -> None:
            _keep(targets[name], folder, result)
            on_done(name)

        def tick() -> None:
            live = {n: _live(study, targets[n], folder) for n in tasks}
            done = before + sum(fraction for fraction, _ in live.values())
            text = next((text for _, text in reversed(live.values()) if text), "")
            progress(text, int(1000 * done), 1000 * len(targets))

        def stages() -> Iterator[Stage]:
            for kind, function in _TASKS.items():
                chosen = {n: t for n, t in tasks.items() if targets[n][0] == kind}
                if kind == "safety":
                    chosen = _with_policies(chosen, targets, folder)
                yield function, chosen

        kinds = Counter(targets[name][0] for name in tasks)
        most = max(kinds.values(), default=0)
        failures = run(stages(), engine, most, on_done=finished, on_tick=tick)
        if failures and is_new and holds_only(folder, _NO_RESULTS):
            shutil.rmtree(folder, ignore_errors=True)  # nothing is finished
        return failures


def _with_policies(
    tasks: Mapping[str, dict[str, Any]], targets: Mapping[str, _Target], folder: Path
) -> dict[str, dict[str, Any]]:
    """The tasks whose seed is trained, with its policy."""
    found = {}
    for name, task in tasks.items():
        _, agent, seed = targets[name]
        place = seed_folder(folder, agent, seed)
        if (place / "metrics.json").is_file():
            policy = (place / "policy.safetensors").read_bytes()
            found[name] = {**task, "seed": seed, "policy": policy}
    return found


def _names(study: Study) -> dict[str, _Target]:
    """Kind, agent and seed of every task by name."""
    names: dict[str, _Target] = {"methods": ("methods", "", 0)} if study.methods else {}
    if study.clairvoyant is not None:
        names["clairvoyant"] = ("clairvoyant", "", 0)
    for seed in range(study.seeds):
        names |= {f"{agent} seed {seed}": ("seed", agent, seed) for agent in study.agents}
        if study.safety_episodes is not None:
            for agent in study.agents:
                names[f"{agent} seed {seed}, violations"] = ("safety", agent, seed)
    return names


def _missing(
    study: Study, plant: AbstractPlant, folder: Path, checkpoint_seconds: float
) -> dict[str, dict[str, Any]]:
    """The unfinished tasks, with the arguments of each."""
    tasks = {}
    for name, (kind, agent, seed) in _names(study).items():
        if _is_finished(study, plant, (kind, agent, seed), folder):
            continue
        own = {}
        if kind == "seed":
            place = seed_folder(folder, agent, seed)
            for path in (place, *place.parents):
                if path.is_file():
                    raise ValueError(f"{path} is a file where a folder is needed; move it away")
            own = {"agent": agent, "seed": seed, "folder": str(place.absolute())}
            own["checkpoint_seconds"] = checkpoint_seconds
        tasks[name] = own
    return tasks


def _keep(target: _Target, folder: Path, result: Any) -> None:
    """Writes the result of a task; the file that marks it as finished is the last."""
    kind, agent, seed = target
    place = seed_folder(folder, agent, seed)
    if kind != "seed":
        write_json((place if kind == "safety" else folder) / f"{kind}.json", result)
        return
    write_bytes(place / "policy.safetensors", result["policy"])
    columns = {name: [row[name] for row in result["curve"]] for name in result["curve"][0]}
    write_bytes(place / "curve.csv", csv_text(columns).encode())
    write_json(place / "metrics.json", result["metrics"])
    (place / "checkpoint.safetensors").unlink(missing_ok=True)
    remove_progress(place)


def _live(study: Study, target: _Target, folder: Path) -> tuple[float, str]:
    """Progress of a task, and its newest validation of the policy."""
    kind, agent, seed = target
    place = seed_folder(folder, agent, seed)
    if kind != "seed":
        where = place if kind == "safety" else folder
        return float((where / f"{kind}.json").is_file()), ""
    if (place / "metrics.json").is_file():
        return 1.0, ""
    row, phase = read_progress(place), read_phase(place)
    own, steps = study.agent(agent), 0.0 if row is None else row["steps"] or 0.0
    share = steps / own.total_steps(study.num_steps)
    if phase:
        return share, f"{agent} seed {seed}: {phase}"
    if row is None:
        return share, ""
    return share, f"{agent} seed {seed}: {own.stage(steps, study.num_steps)}; {_looks(row)}"


def _looks(row: Mapping[str, float | None]) -> str:
    """Numbers of the newest validation; those that are not finite are left out."""
    known = {name: value for name, value in row.items() if value is not None}
    parts = [f"return {known['return']:.3g}"] if "return" in known else []
    parts += [
        f"{name.removeprefix('relative_error_')} {100 * value:.3g} %"
        for name, value in known.items()
        if name.startswith("relative_error_")
    ]
    if "violation_rate" in known:
        parts.append(f"violations {100 * known['violation_rate']:.0f} %")
    return ", ".join(parts)
