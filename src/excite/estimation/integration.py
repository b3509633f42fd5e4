"""Whether the plant is integrated finely enough for what the data tell."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ..description import names_of
from ..plant import AbstractPlant
from .contract import Estimate, Experiments, residual_of, simulate_experiments
from .diagnosis import inverse_information
from .nls import NLS

_ENOUGH = 0.5  # standard errors by which an estimate may change with a finer integration
_LEAST = 1e-4  # relative change that is told


def too_coarse(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: NLS,
    estimate: Estimate,
    free: np.ndarray,
    std_error: Float[np.ndarray, " param"],
) -> tuple[str, ...]:
    """A sentence where twice the Runge-Kutta steps would change an estimate noticeably.

    By the implicit function theorem an estimate changes by -(S' S)^-1 S' d, for sensitivities S
    and a change d of the residual; no part of it is more than |d| standard errors.
    """
    experiments, estimate, is_free = jax.device_put((experiments, estimate, free))
    finer = plant.integrated_in(2 * plant.substeps)
    sd = np.asarray(estimator.weights(plant, experiments, estimate))
    noise = np.linalg.norm(np.asarray(estimate.residual) / sd) / math.sqrt(estimate.residual.size)
    change = np.asarray(_residual(finer, experiments, estimate) - estimate.residual) / sd
    if not np.linalg.norm(change) > _ENOUGH * noise:
        return ()
    S = np.asarray(estimator.sensitivity(plant, experiments, estimate, is_free)[0])
    P = np.asarray(estimator.prior_information(plant, estimate, S.shape[-1], is_free))
    moves = inverse_information(S, P) @ np.einsum("etou,eto->u", S, change)
    d, values = plant.definition, map(float, estimate.params)
    size = [v if p.positive else p.scale for p, v in zip(d.parameters, values, strict=True)]
    moves = np.where(free, np.abs(moves[: len(free)]), 0.0)
    moves = np.where(moves > _LEAST, moves, 0.0) * size
    parts = np.divide(moves, std_error, out=np.zeros(len(free)), where=std_error > 0)
    worst = int(np.argmax(parts))
    if not parts[worst] > _ENOUGH:
        return ()
    return (
        f"the integration is too coarse for these data: with substeps={2 * d.substeps} in the "
        f"plant's definition, now {d.substeps}, {names_of(d.parameters)[worst]} would change by "
        f"{parts[worst]:.2g} standard errors",
    )


@eqx.filter_jit
def _residual(
    plant: AbstractPlant, experiments: Experiments, estimate: Estimate
) -> Float[Array, "experiment sample output"]:
    """Measured minus simulated outputs."""
    simulated = simulate_experiments(plant, estimate.params, experiments, estimate.initial_state)
    return residual_of(experiments, simulated)
