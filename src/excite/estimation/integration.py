"""Whether the plant is integrated finely enough for what the data tell."""

from __future__ import annotations

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..description import names_of
from ..plant import AbstractPlant, Params
from .contract import Estimate, Experiments, residual_of, simulate_experiments
from .diagnosis import inverse_information
from .nls import NLS

_ENOUGH = 0.5  # standard errors by which an estimate may change with a finer integration
_LONGEST = 5_000  # samples, of all experiments together, that are integrated again
_LEAST = 1e-4  # relative change that is told


def infinite_slope(
    plant: AbstractPlant, params: Params, experiments: Experiments
) -> tuple[str, ...]:
    """A sentence where the plant's equations have an infinite slope at an initial state.

    The search needs all slopes; that of a root at zero is infinite.
    """
    states = names_of(plant.definition.states)
    for state, inputs in zip(experiments.initial_state, experiments.inputs, strict=True):
        slopes = np.asarray(jax.jacfwd(plant.derivative)(state, inputs[0], params))
        if not np.isfinite(slopes).all():
            i, j = np.argwhere(~np.isfinite(slopes))[0]
            return (
                f"the slope of the derivative of {states[i]} over {states[j]} is not finite at "
                f"{states[j]} = {float(state[j]):g}, where the simulation begins (a root, a "
                "logarithm or a division of zero?): give the state another initial value in the "
                "plant, or keep what stands there above zero: jnp.sqrt(jnp.maximum(x, 1e-6))",
            )
    return ()


def too_coarse(
    plant: AbstractPlant,
    experiments: Experiments,
    estimate: Estimate,
    free: np.ndarray,
    std_error: Float[np.ndarray, " param"],
    room: tuple[int, int] = (0, 0),
) -> tuple[str, ...]:
    """A sentence where twice the Runge-Kutta steps would change an estimate noticeably.

    By the implicit function theorem an estimate changes by -(S' S)^-1 S' d, for sensitivities S
    and a change d of the residual; no part of it is more than |d| standard errors. Outputs have
    the weights that `NLS` begins with. With a long record more steps may be needed, because its
    standard errors are smaller.
    """
    experiments = experiments.padded(*room)  # as for the search: compiled once
    estimate = estimate.of(experiments)
    experiments, estimate, is_free = jax.device_put((experiments, estimate, free))
    part, own, change, noise = _changed(plant, experiments, estimate)
    if np.linalg.norm(change) <= _ENOUGH * float(noise):
        return ()
    d, dt, steps = plant.definition, float(plant.dt), 2 * plant.substeps
    needed = math.floor((steps - 1 + 2e-3) * d.dt / dt) + 1  # in the definition, for these data
    advice = f"the integration is too coarse for these data: with substeps={needed} in the plant's "
    if not np.all(np.isfinite(change)):
        return (f"{advice}definition, now {d.substeps}, the simulation diverges",)
    S = np.asarray(NLS().sensitivity(plant, part, own, is_free)[0])
    moves = inverse_information(S) @ np.einsum("etou,eto->u", S, change)
    values = map(float, estimate.params)
    size = [v if p.positive else p.scale for p, v in zip(d.parameters, values, strict=True)]
    moves = np.where(free, np.abs(moves[: len(free)]), 0.0)
    moves = np.where(moves > _LEAST, moves, 0.0) * size
    parts = np.divide(moves, std_error, out=np.zeros(len(free)), where=std_error > 0)
    worst = int(np.argmax(parts))
    if not parts[worst] > _ENOUGH:
        return ()
    return (
        f"{advice}definition, now {d.substeps}, {names_of(d.parameters)[worst]} would change by "
        f"{parts[worst]:.2g} standard errors",
    )


@eqx.filter_jit
def _changed(
    plant: AbstractPlant, experiments: Experiments, estimate: Estimate
) -> tuple[Experiments, Estimate, Float[Array, "experiment sample output"], Float[Array, ""]]:
    """The change of the residual by twice the steps, and its size in all samples, over the weights.

    It is that of the first samples of each experiment; these and their estimate stand before it.
    """
    e, n = experiments, max(_LONGEST // len(experiments.valid), 2)
    sd = NLS().weights(plant, experiments, estimate)[None, None]
    noise = jnp.sqrt(jnp.sum((estimate.residual / sd) ** 2) / jnp.sum(e.valid))
    valid = e.valid[:, :n]
    if plant.has_feedthrough:  # the input of the last sample is cut off
        valid = valid.at[:, -1].set(False)
    part = dataclasses.replace(
        e,
        inputs=e.inputs[:, : n - 1],
        measured=e.measured[:, :n],
        valid=valid,
        dt=None if e.dt is None else e.dt[:, : n - 1],
        next_inputs=None if e.next_inputs is None else e.next_inputs[:, : n - 1],
    )
    residual = jnp.where(valid, estimate.residual[:, :n], 0.0)
    own = eqx.tree_at(lambda x: x.residual, estimate, residual)
    finer = plant.integrated_in(2 * plant.substeps)
    simulated = simulate_experiments(finer, estimate.params, part, estimate.initial_state)
    return part, own, (residual_of(part, simulated) - own.residual) / sd, noise
