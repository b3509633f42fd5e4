"""Whether the plant is integrated finely enough for what the data tell."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..description import names_of
from ..plant import AbstractPlant
from .contract import Estimate, Experiments, residual_of, simulate_experiments
from .diagnosis import inverse_information
from .nls import NLS

_ENOUGH = 0.5  # standard errors by which an estimate may change with a finer integration
_LONGEST = 5_000  # samples of an experiment that are integrated again
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
    and a change d of the residual; no part of it is more than |d| standard errors. With a long
    record more steps may be needed, because its standard errors are smaller.
    """
    experiments, estimate, is_free = jax.device_put((experiments, estimate, free))
    part, estimate, change, noise = _changed(plant, experiments, estimator, estimate)
    if not np.linalg.norm(change) > _ENOUGH * float(noise):
        return ()
    S = np.asarray(estimator.sensitivity(plant, part, estimate, is_free)[0])
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
def _changed(
    plant: AbstractPlant, experiments: Experiments, estimator: NLS, estimate: Estimate
) -> tuple[Experiments, Estimate, Float[Array, "experiment sample output"], Float[Array, ""]]:
    """The change of the residual by twice the steps, and its own size, over the weights.

    Of the first samples of each experiment, which tell as well as all, and which come first.
    """
    sd = estimator.weights(plant, experiments, estimate)[None, None]
    noise = jnp.sqrt(jnp.mean((estimate.residual / sd) ** 2))
    e, n = experiments, _LONGEST
    part = Experiments(
        inputs=e.inputs[:, : n - 1],
        measured=e.measured[:, :n],
        valid=e.valid[:, :n],
        initial_state=e.initial_state,
        initial_state_known=e.initial_state_known,
        dt=None if e.dt is None else e.dt[:, : n - 1],
        next_inputs=None if e.next_inputs is None else e.next_inputs[:, : n - 1],
    )
    estimate = eqx.tree_at(lambda x: x.residual, estimate, estimate.residual[:, :n])
    finer = plant.integrated_in(2 * plant.substeps)
    simulated = simulate_experiments(finer, estimate.params, part, estimate.initial_state)
    return part, estimate, (residual_of(part, simulated) - estimate.residual) / sd, noise
