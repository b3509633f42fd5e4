"""What a worker does for a study that measures its methods by clairvoyant signals.

They are designed for the first plants of the evaluation episodes, each as if its parameters
were known, so that an efficiency compares methods on the same plants.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..design import clairvoyant_signals, signal_env
from ..evaluation import Episodes, evaluate
from ..excitation import Replay
from ..plant import AbstractPlant
from .base import episode_keys, outcome, table_row, unpacked

METHOD = "clairvoyant"


def clairvoyant_task(study: Mapping[str, Any], plant: Mapping[str, Any]) -> dict[str, Any]:
    """Rows of the clairvoyant signals, and how well their starts agree."""
    with unpacked(study, plant) as (chosen, built):
        if chosen.clairvoyant is None:
            raise ValueError("the study has no clairvoyant signals")
        keys = episode_keys(chosen)[: chosen.clairvoyant.plants]
        env = signal_env(built, chosen.num_steps, chosen.spread)
        design = clairvoyant_signals(env, keys, chosen.clairvoyant.starts)
        episodes = _played(built, jnp.asarray(design.inputs), chosen.spread, keys)
        rows = [
            table_row(chosen, built.description, (METHOD, name), outcome(built, e, episodes))
            for name, e in chosen.build_estimators(built).items()
        ]
        spread = np.ptp(design.worth_by_start, axis=1)
        return {"rows": rows, "log_det_spread_of_starts": spread.tolist()}


@eqx.filter_jit
def _played(
    plant: AbstractPlant,
    inputs: Float[Array, "episode time input"],
    spread: float,
    keys: Key[Array, " episode"],
) -> Episodes:
    """Each signal on its own plant."""

    def one(own: Float[Array, "time input"], key: Key[Array, ""]) -> Episodes:
        episodes = evaluate(plant, Replay(own), len(own), spread, key[None])
        return jax.tree.map(lambda leaf: leaf[0], episodes)

    return jax.vmap(one)(inputs, keys)
