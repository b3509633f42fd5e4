"""One episode of every method and agent, for reports.

All play on the same plant with the same noise, that of the first evaluation episode.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import jax
import numpy as np
from jaxtyping import Array, Float

from ..description import PlantDescription, names_of
from ..environment import run_episodes
from ..estimation import ARX
from ..estimation.arx import running_params
from ..excitation import AbstractExcitation, PolicyExcitation
from ..plant import AbstractARXPlant, AbstractPlant
from ..policy import read_policy
from ..record import Record
from .folder import damaged, seed_folder
from .methods import CHUNK, episode_keys
from .spec import Study

_DIGITS = 6  # more than a figure can show


def example_episodes(
    study: Study, folder: Path = Path(), seeds: Mapping[str, int] = MappingProxyType({})
) -> dict[str, tuple[Record, np.ndarray]]:
    """The first evaluation episode of every method and agent, and its running estimates.

    The estimates are those of the study's first ARX estimator, over the true parameters;
    NaN where there is none.

    Args:
        folder: of the run, where there are agents.
        seeds: by agent, the one to show.
    """
    plant, episodes = study.build_plant(), {}
    given = study.build_uncertainty(plant), study.coast, study.build_prior(plant)
    keys = episode_keys(study)[:CHUNK]  # as for the table: no new compilation
    for name, seed, excitation in _excitations(study, plant, folder, seeds):
        batch = run_episodes(plant, excitation, study.num_steps, study.spread, keys, *given)
        run, params = jax.tree.map(lambda leaf: leaf[0], (batch.trajectory, batch.params))
        estimator, estimates = _running(study, plant, run.inputs, run.measured)
        about = {"estimator": estimator, **({} if seed is None else {"seed": seed})}
        record = Record.of_episode(run.time, run.inputs, run.outputs, about)
        episodes[name] = record, estimates / np.stack(params)
    return episodes


def _excitations(
    study: Study, plant: AbstractPlant, folder: Path, seeds: Mapping[str, int]
) -> Iterator[tuple[str, int | None, AbstractExcitation]]:
    """Name, seed of an agent, and excitation of each method and agent."""
    for name, excitation in study.build_methods(plant).items():
        yield name, None, excitation
    for agent, seed in seeds.items():
        path = seed_folder(folder, agent, seed) / "policy.safetensors"
        try:
            yield agent, seed, PolicyExcitation.of(read_policy(path))
        except ValueError:
            raise damaged(path) from None


def _running(
    study: Study,
    plant: AbstractPlant,
    inputs: Float[Array, "time input"],
    measured: Float[Array, "sample output"],
) -> tuple[str, np.ndarray]:
    for name, estimator in study.build_estimators(plant).items():
        if isinstance(estimator, ARX) and isinstance(plant, AbstractARXPlant):
            return name, np.asarray(running_params(estimator, plant, inputs, measured))
    return "", np.full((len(measured), len(names_of(plant.definition.parameters))), np.nan)


def episodes_data(
    description: PlantDescription, episodes: Mapping[str, tuple[Record, np.ndarray]]
) -> dict[str, dict[str, object]]:
    """Episodes as JSON-ready data; docs/reference/machine-readable.md documents the keys."""

    def columns(names: Sequence[str], values: np.ndarray) -> dict[str, list[float]]:
        return dict(zip(names, map(_rounded, np.transpose(values)), strict=True))

    return {
        name: {
            **record.metadata,
            "time": _rounded(record.time),
            "inputs": columns(names_of(description.inputs), record.inputs),
            "outputs": columns(names_of(description.outputs), record.outputs),
            "estimate_over_true": columns(names_of(description.parameters), estimates),
        }
        for name, (record, estimates) in episodes.items()
    }


def _rounded(values: np.ndarray) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in np.asarray(values).tolist()]
