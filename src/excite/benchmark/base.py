"""Methods x estimators over common plants and noise.

Every method meets the same plants and the same sensor noise, episode by episode; every
estimator sees the same data. Beside each error stands the Cramér-Rao bound of the data it
was made from, so that a reader sees how much of an error is the excitation's and how much
the estimator's.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from .. import files
from ..description import HALF_95, PlantDescription, display_unit, names_of
from ..estimation import AbstractEstimator, Status, stack_experiments
from ..evaluation import Episodes, evaluate
from ..excitation import AbstractExcitation
from ..files import folder_word
from ..information import d_optimality, require_noise
from ..plant import AbstractPlant
from ..rig.prediction import SafetyFilter
from ..rig.simulated import bodies, evaluate_on_rig, readings_per_sample
from ..safety import Supervision, Trip, watched_output
from ..simulation import Trajectory
from ..study import Study, study_from

CHUNK = 100
"""Episodes computed in one call: enough to be fast, few enough to show progress."""

Progress = Callable[[str, int, int], None]
"""Called with what is being computed, how much of it is done, and how much there is."""


@eqx.filter_jit
def estimate_all(
    plant: AbstractPlant, estimator: AbstractEstimator, trajectory: Trajectory
) -> tuple[Float[Array, "episode param"], Float[Array, "episode param"], Array]:
    """Estimates, standard errors and status of every episode; initial states are known."""

    def one(inputs: Array, measured: Array) -> tuple[Array, Array, Array]:
        data = stack_experiments(plant, [inputs], [measured], True)
        estimate = estimator(plant, data)
        variance = jnp.diagonal(estimate.covariance)
        return jnp.stack(estimate.params), jnp.sqrt(variance), estimate.status

    return jax.vmap(one)(trajectory.inputs, trajectory.measured)


def episode_keys(study: Study) -> Key[Array, " episode"]:
    """Keys of the study's evaluation episodes."""
    return jax.random.split(jax.random.key(study.seed), study.episodes)


class Outcome(eqx.Module):
    """All episodes of one method and one estimator, on NumPy arrays.

    Attributes:
        on_rig: what else happened on a simulated rig, by name; empty without one.
    """

    true: Float[np.ndarray, "episode param"]
    estimated: Float[np.ndarray, "episode param"]
    std_error: Float[np.ndarray, "episode param"]
    status: np.ndarray
    is_violation: np.ndarray
    max_abs_output: Float[np.ndarray, "episode output"]
    bound: Float[np.ndarray, "episode param"]
    log_det: Float[np.ndarray, " episode"]
    on_rig: Mapping[str, np.ndarray]


Play = Callable[[AbstractExcitation, Any], tuple[Episodes, dict[str, np.ndarray]]]
"""Plays an excitation once for every key; with what else happened on a rig."""


def num_chunks(study: Study) -> int:
    """Calls in which the episodes of one method are computed."""
    return -(-study.episodes // CHUNK)


def player_of(study: Study, plant: AbstractPlant) -> Play:
    """How the study's experiments are made: on the plant, or on its simulated rig."""
    if study.rig is None:
        return lambda excitation, keys: (
            evaluate(plant, excitation, study.num_steps, study.spread, keys),
            {},
        )
    rules, numbers = Supervision.of(plant.description), study.rig.numbers()
    safety = SafetyFilter.of(plant, study.spread) if study.rig.filter else None

    def play(excitation: AbstractExcitation, keys: Any) -> tuple[Episodes, dict[str, np.ndarray]]:
        many = bodies(plant, readings_per_sample(plant), study.spread, keys, **numbers)
        on_rig = plant, excitation, many, rules, study.num_steps
        episodes, runs = evaluate_on_rig(*on_rig)
        seen = {"trips": runs.trip != int(Trip.NONE)}
        if safety is not None:
            _, runs = evaluate_on_rig(*on_rig, safety, safety.start())
            seen["filtered_violations"] = runs.is_violation
            seen["filtered_trips"] = runs.trip != int(Trip.NONE)
            seen["interventions"] = runs.num_interventions
        return episodes, {name: np.asarray(counts) for name, counts in seen.items()}

    return play


def evaluate_method(
    study: Study,
    plant: AbstractPlant,
    name: str,
    excitation: AbstractExcitation,
    progress: Callable[[int], None] = lambda _: None,
) -> tuple[list[dict[str, Any]], Float[np.ndarray, " input"]]:
    """One row an estimator for one method, and each input's root mean square.

    The latter counts from the middle of the input's limits.

    Raises:
        ValueError: for a sensor without noise, which has no Cramér-Rao bound.
    """
    require_noise(plant)
    estimators = study.build_estimators(plant)
    middle = np.mean(plant.input_limits, axis=0)
    keys = episode_keys(study)
    outcomes: dict[str, list[Outcome]] = {e: [] for e in estimators}
    play, squares = player_of(study, plant), []
    for c, first in enumerate(range(0, study.episodes, CHUNK)):
        progress(c)
        chunk = keys[first : first + CHUNK]
        episodes, on_rig = play(excitation, chunk)
        inputs = np.asarray(episodes.trajectory.inputs) - middle
        squares.append(np.mean(inputs**2, axis=1))
        for e, estimator in estimators.items():
            outcomes[e].append(outcome(plant, estimator, episodes, on_rig))
    own = _of_method(study, plant, excitation)
    rows = [
        {**table_row(study, plant.description, (name, e), joined(parts)), **own}
        for e, parts in outcomes.items()
    ]
    return rows, np.sqrt(np.concatenate(squares).mean(axis=0))


def _of_method(
    study: Study, plant: AbstractPlant, excitation: AbstractExcitation
) -> dict[str, Any]:
    """Bounds of shorter experiments, where the study asks for them; signals are replanned."""
    if not study.lengths:
        return {}
    keys = episode_keys(study)[:CHUNK]
    bounds = [
        np.asarray(evaluate(plant, excitation, length, study.spread, keys).bound).mean(axis=0)
        for length in study.lengths
    ]
    names = names_of(plant.definition.parameters)
    percent = {
        n: (100 * values).tolist() for n, values in zip(names, np.transpose(bounds), strict=True)
    }
    return {"bound_by_length": {"num_steps": list(study.lengths), "cramer_rao_percent": percent}}


def outcome(
    plant: AbstractPlant,
    estimator: AbstractEstimator,
    episodes: Episodes,
    on_rig: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> Outcome:
    """What an estimator makes of a batch of episodes."""
    estimated, std_error, status = estimate_all(plant, estimator, episodes.trajectory)
    return Outcome(
        true=np.stack(episodes.params, axis=1),
        estimated=np.asarray(estimated),
        std_error=np.asarray(std_error),
        status=np.asarray(status),
        is_violation=np.asarray(episodes.is_violation),
        max_abs_output=np.asarray(episodes.max_abs_output),
        bound=np.asarray(episodes.bound),
        log_det=np.asarray(jax.vmap(d_optimality)(episodes.information)),
        on_rig=on_rig,
    )


def joined(parts: list[Outcome]) -> Outcome:
    """Several batches as one."""
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)


def table_row(
    study: Study, description: PlantDescription, names: tuple[str, str], outcome: Outcome
) -> dict[str, Any]:
    """One row of the table; its keys are documented in docs/machine-readable.md.

    Args:
        names: of method and estimator.
    """
    is_tripped = outcome.on_rig.get("trips", np.zeros(len(outcome.status), bool))
    good = (outcome.status == Status.SUCCESSFUL) & ~is_tripped
    error = (outcome.estimated / outcome.true - 1)[good]
    std_error = (outcome.std_error / np.abs(outcome.true))[good]
    violations, count = int(outcome.is_violation.sum()), len(good)
    watched = watched_output(description)
    unit, factor = display_unit(description.outputs[watched].unit)
    reasons = ["tripped"] * int(is_tripped.sum())
    reasons += [Status(s).name.lower() for s in outcome.status[~good & ~is_tripped]]

    def by_name(values: Any) -> dict[str, Any]:
        return dict(zip(names_of(description.parameters), values, strict=True))

    return {
        "method": names[0],
        "estimator": names[1],
        "evaluations": count,
        "failed": int(count - good.sum()),
        "failures": {reason: reasons.count(reason) for reason in sorted(set(reasons))},
        "violations": violations,
        "violation_rate": violation_rate(violations, count),
        **_on_rig(outcome.on_rig),
        "max_abs_output": {
            "output": description.outputs[watched].name,
            **mean_sd(factor * outcome.max_abs_output[:, watched]),
            "unit": unit,
        },
        "log_det_information": float(outcome.log_det.mean()),
        "log_det_information_sd": mean_sd(outcome.log_det)["sd"],
        **_paired_log_det(study, outcome),
        "relative_error_percent": by_name(_error(100 * np.abs(e)) for e in error.T),
        "cramer_rao_percent": by_name(100 * outcome.bound.mean(axis=0)),
        "rms_over_cramer_rao": by_name(_rms(error) / _rms(outcome.bound[good])),
        "coverage95_percent": by_name(100 * _fraction(np.abs(error) < HALF_95 * std_error)),
        "beyond_6_std_errors": int(np.any(np.abs(error) > 6 * std_error, axis=1).sum()),
    }


def _on_rig(seen: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """What a row has beside the rest where experiments were made on a simulated rig."""
    return {"on_rig": {name: int(counts.sum()) for name, counts in seen.items()}} if seen else {}


def _paired_log_det(study: Study, outcome: Outcome) -> dict[str, float]:
    """Mean over the plants that the clairvoyant signals are designed for."""
    if study.clairvoyant is None:
        return {}
    return {
        "log_det_of_clairvoyant_plants": float(outcome.log_det[: study.clairvoyant.plants].mean())
    }


def _rms(values: Float[np.ndarray, "episode param"]) -> Float[np.ndarray, " param"]:
    return np.sqrt(_fraction(values**2))


def _fraction(values: np.ndarray) -> Float[np.ndarray, " param"]:
    """Mean over episodes; not a number where no episode is left."""
    return values.mean(axis=0) if len(values) else np.full(values.shape[1], np.nan)


def mean_sd(values: np.ndarray) -> dict[str, float]:
    """Mean and standard deviation, where there are any."""
    return {
        "mean": float(values.mean()) if values.size else math.nan,
        "sd": float(values.std(ddof=1)) if values.size > 1 else math.nan,
    }


def _error(values: np.ndarray) -> dict[str, float]:
    """Mean and standard deviation of errors, and what a few large ones do not move."""
    if not values.size:
        return {**mean_sd(values), "median": math.nan, "rms": math.nan}
    rms = float(np.sqrt(np.mean(values**2)))
    return {**mean_sd(values), "median": float(np.median(values)), "rms": rms}


def violation_rate(violations: int, count: int) -> dict[str, Any]:
    """The rate and its interval, as rows have it."""
    return {"estimate": violations / count, "ci95": wilson(violations, count)}


def wilson(successes: int, count: int) -> tuple[float, float]:
    """95 % interval of a rate.

    E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    J. American Statistical Association 22, 1927.
    """
    z, rate = HALF_95, successes / count
    centre = rate + z**2 / (2 * count)
    half = z * math.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    scale = 1 + z**2 / count
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


def seed_folder(folder: Path, agent: str, seed: int) -> Path:
    """Where a seed of an agent keeps its files."""
    return folder / "seeds" / folder_word(agent) / str(seed)


def agent_settings(study: Study, plant: AbstractPlant, agent: str) -> dict[str, Any]:
    """All that decides what a seed of an agent becomes but the plant, JSON-ready."""
    own = study.agent(agent).settings(plant)
    return {**own, "spread": study.spread, "num_steps": study.num_steps}


def fingerprint(study: Study, plant: AbstractPlant, agent: str) -> str:
    """SHA-256 of those settings and the plant's hash."""
    settings = {**agent_settings(study, plant, agent), "plant": plant.description.hash}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


@contextlib.contextmanager
def unpacked(
    settings: Mapping[str, Any], source: Mapping[str, Any]
) -> Iterator[tuple[Study, AbstractPlant]]:
    """The study of a task and its plant; a user's plant file lies here while it is needed.

    Args:
        settings: of the study.
        source: `text`, the source of a user's own plant or None, and the plant's `hash`.
    """
    settings = dict(settings)
    with tempfile.TemporaryDirectory() as folder:
        if source["text"] is not None:
            path, _, class_name = str(settings["plant"]).rpartition(":")
            file = Path(folder) / Path(path).name
            file.write_text(source["text"], encoding="utf-8")
            settings["plant"] = f"{file}:{class_name}"
        study = study_from(settings, "study")
        plant = study.build_plant()
        if plant.description.hash != source["hash"]:
            raise ValueError(
                f"the plant {plant.definition.name!r} of this worker is another one "
                f"(hash {plant.description.hash[:8]}) than that of the study "
                f"({source['hash'][:8]})"
            )
        yield study, plant


def study_of(folder: Path) -> Study:
    """The study of a run folder; ValueError where there is none."""
    path = folder / "study.json"
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    if not path.is_file():
        raise ValueError(f"{folder} holds no study")
    try:
        return study_from(read_json(path), "settings")
    except ValueError:
        raise damaged(path) from None


def read_json(path: Path, *keys: str) -> dict[str, Any]:
    """Content of a file of a run folder, an object with these keys.

    Raises:
        ValueError: where it cannot be read, or holds something else.
    """
    return files.read_json(path, *keys, advice=_advice(path))


_REMEDIES = {
    "study.json": "if the folder is of this study, delete the file: 'excite study run' writes it",
    "run.json": "if the folder is of this study, delete the file: 'excite study run' writes it",
    "clairvoyant.json": "delete it: 'excite study run' designs them again",
    "methods.json": "delete it: 'excite study run' computes it again",
    "table.json": "delete it: 'excite study run' writes it again",
}


def read_columns(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Columns of a CSV file of a run folder, these among them; ValueError for another file."""
    return files.read_columns(path, names, advice=_advice(path))


def _advice(path: Path) -> str:
    of_seed = f"delete {path.parent}: 'excite study run' trains that seed from the beginning"
    return _REMEDIES.get(path.name, of_seed)


def damaged(path: Path) -> ValueError:
    """The error for a file of a run folder that is not as it was written, and what helps."""
    return files.damaged(path, _advice(path))
