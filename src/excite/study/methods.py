"""Methods x estimators over common plants and noise.

Every method meets the same plants and the same sensor noise, episode by episode; every
estimator sees the same data.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..description import names_of
from ..environment import Episodes, run_episodes
from ..estimation import NLS, AbstractEstimator, stack_experiments
from ..estimation.contract import transitions
from ..estimation.information_gain import information_gain
from ..excitation import AbstractExcitation
from ..information import d_optimality, require_bound
from ..plant import AbstractPlant
from ..progress import Progress
from ..report.rows import BoundByLength, ExpectedGain, Nats, Row, StudyFacts
from ..report.study_table import StudyTable
from ..rig.filter import SafetyFilter
from ..rig.simulated import drawn_hardware, evaluate_on_rig, readings_per_sample
from ..safety import Supervision, Trip
from ..simulation import DivergedError, Trajectory
from .spec import GainSettings, Study
from .statistics import Scores, table_row

CHUNK = 100
"""Episodes computed in one call: enough to be fast, few enough to show progress."""
_SIDE_BY_SIDE = 10  # estimates: more do not fit the cache, and wait for the slowest search


@eqx.filter_jit
def estimate_all(
    plant: AbstractPlant, estimator: AbstractEstimator, trajectory: Trajectory
) -> tuple[Float[Array, "episode param"], Float[Array, "episode param"], Array]:
    """Estimates, standard errors and status of every episode; initial states are known."""

    def one(rows: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        inputs, measured = rows
        seen, data = plant, stack_experiments(plant, [inputs], [measured], True)
        if plant.definition.observes_state and isinstance(estimator, NLS):
            seen, data = transitions(plant, data)
        estimate = estimator(seen, data)
        variance = jnp.diagonal(estimate.covariance)
        return jnp.stack(estimate.params), jnp.sqrt(variance), estimate.status

    return jax.lax.map(one, (trajectory.inputs, trajectory.measured), batch_size=_SIDE_BY_SIDE)


def episode_keys(study: Study) -> Key[Array, " episode"]:
    """Keys of the study's evaluation episodes."""
    return jax.random.split(jax.random.key(study.seed), study.episodes)


Keys = Key[Array, " episode"]
Play = Callable[[AbstractExcitation, Keys], tuple[Episodes, dict[str, np.ndarray]]]
"""Plays an excitation once for every key; also returns the events on a rig."""


def num_chunks(study: Study) -> int:
    """Number of calls in which the episodes of one method are computed."""
    return -(-study.episodes // CHUNK)


def player_of(study: Study, plant: AbstractPlant) -> Play:
    """A function that makes the study's experiments: on the plant, or on its simulated rig."""
    if study.rig is None:
        given = study.build_uncertainty(plant), study.coast, study.build_prior(plant)
        return lambda excitation, keys: (
            run_episodes(plant, excitation, study.num_steps, study.spread, keys, *given),
            {},
        )
    rules, numbers = Supervision.of(plant.description), study.rig.numbers()
    safety = SafetyFilter.of(plant, study.spread) if study.rig.filter else None

    def play(excitation: AbstractExcitation, keys: Keys) -> tuple[Episodes, dict[str, np.ndarray]]:
        many = drawn_hardware(plant, readings_per_sample(plant), study.spread, keys, **numbers)
        on_rig = plant, excitation, many, rules, study.num_steps
        episodes, runs = evaluate_on_rig(*on_rig)
        seen = {"trips": runs.trip != int(Trip.NONE)}
        if safety is not None:
            _, runs = evaluate_on_rig(*on_rig, safety)
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
) -> tuple[list[Row], Float[np.ndarray, " input"]]:
    """One row per estimator for one method, and each input's root mean square.

    The latter is relative to the middle of the input's limits.

    Raises:
        ValueError: for a sensor without noise, which has no Cramér-Rao bound.
    """
    require_bound(plant)
    estimators = study.build_estimators(plant)
    middle = np.mean(plant.input_limits, axis=0)
    keys = episode_keys(study)
    parts: dict[str, list[Scores]] = {e: [] for e in estimators}
    play, squares = player_of(study, plant), []
    for c, first in enumerate(range(0, study.episodes, CHUNK)):
        progress(c)
        chunk = keys[first : first + CHUNK]
        episodes, on_rig = play(excitation, chunk)
        inputs = np.asarray(episodes.trajectory.inputs) - middle
        squares.append(np.mean(inputs**2, axis=1))
        for e, estimator in estimators.items():
            parts[e].append(scores(plant, estimator, episodes, on_rig))
    rows = [table_row(study, plant.description, (name, e), joined(p)) for e, p in parts.items()]
    if study.lengths:
        bounds = {"bound_by_length": _bound_by_length(study, plant, excitation)}
        rows = [row.model_copy(update=bounds) for row in rows]
    if study.gain is not None:
        gained = {"expected_gain": _expected_gain(study, plant, excitation)}
        rows = [row.model_copy(update=gained) for row in rows]
    return rows, np.sqrt(np.concatenate(squares).mean(axis=0))


def _expected_gain(
    study: Study, plant: AbstractPlant, excitation: AbstractExcitation
) -> ExpectedGain:
    """What an experiment of the study is expected to tell."""
    own = (study.gain or GainSettings()).model_dump()
    try:
        found = information_gain(
            plant, excitation, steps=study.num_steps, prior=study.prior or None,
            spread=study.spread, seed=study.seed, progress=lambda *_: None, **own,
        )  # fmt: skip
    except DivergedError as error:  # other methods have their figures
        unknown = Nats(mean=math.nan, std_error=math.nan)
        return ExpectedGain(lower=unknown, upper=unknown, warnings=(str(error),), **own)
    lower, upper = (
        Nats(mean=bound.value, std_error=bound.std_error) for bound in (found.lower, found.upper)
    )
    return ExpectedGain(
        lower=lower,
        upper=upper,
        plants=found.num_plants,
        samples=found.num_samples,
        from_prior=found.from_prior,
        warnings=found.warnings,
    )


def _bound_by_length(
    study: Study, plant: AbstractPlant, excitation: AbstractExcitation
) -> BoundByLength:
    """Bounds of shorter experiments; signals are designed again for each length."""
    keys = episode_keys(study)[:CHUNK]
    given = keys, study.build_uncertainty(plant), 0, study.build_prior(plant)
    every = [
        run_episodes(plant, excitation, length, study.spread, *given) for length in study.lengths
    ]
    bounds = [np.asarray(episodes.bound).mean(axis=0) for episodes in every]
    names = names_of(plant.definition.parameters)
    percent = {
        n: tuple((100 * values).tolist())
        for n, values in zip(names, np.transpose(bounds), strict=True)
    }
    return BoundByLength(num_steps=tuple(study.lengths), cramer_rao_percent=percent)


def scores(
    plant: AbstractPlant,
    estimator: AbstractEstimator,
    episodes: Episodes,
    on_rig: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> Scores:
    """The results of an estimator for a batch of episodes."""
    estimated, std_error, status = estimate_all(plant, estimator, episodes.trajectory)
    return Scores(
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


def joined(parts: list[Scores]) -> Scores:
    """Several batches as one."""
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)


def method_rows(study: Study, progress: Progress = lambda *_: None) -> list[Row]:
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


def compared(study: Study, progress: Progress = lambda *_: None) -> StudyTable:
    """The table of a study that has neither agents nor clairvoyant signals."""
    return StudyTable(rows=tuple(method_rows(study, progress)), study=facts(study))


def facts(study: Study) -> StudyFacts:
    """The study as tables and reports read it."""
    return StudyFacts.model_validate(study.model_dump())
