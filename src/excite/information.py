"""What an experiment can tell about its parameters, before anything is estimated.

With outputs y(theta) and independent Gaussian noise of standard deviation sigma, the
Fisher information is M = sum_k S_k' S_k / sigma^2, S = dy/dtheta, and no unbiased
estimator has a covariance below M^-1 (Cramér-Rao; L. Ljung, System Identification, 2nd
ed., ch. 7; G. Goodwin and R. Payne, Dynamic System Identification, 1977). In logarithms
of the parameters all of it is relative, and comparable between parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .description import names_of
from .plant import AbstractPlant, Params
from .simulation import response

Information = Float[Array, "param param"]

UNSEEN_SD = 0.5
"""A direction of relative changes known no better than this is not seen by the data: its
95 % interval reaches from nothing to the double."""


def require_double_precision() -> None:
    """Raises ValueError where JAX computes in single precision."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            "estimation and information need double precision: "
            'call jax.config.update("jax_enable_x64", True) first'
        )


def require_noise(plant: AbstractPlant) -> None:
    """Raises ValueError for a sensor without noise, which has no Cramér-Rao bound."""
    if not np.all(np.asarray(plant.sensor.sd) > 0):
        raise ValueError("a sensor without noise has no Cramér-Rao bound; give it a noise_sd")


def sensitivity(
    response: Callable[[Float[Array, " param"]], Float[Array, "time output"]],
    theta: Float[Array, " param"],
) -> Float[Array, "time output param"]:
    """Derivative of a response with respect to its parameters, in forward mode."""
    require_double_precision()
    return jax.jacfwd(response)(theta)


def fisher_information(
    sensitivity: Float[Array, "time output param"], noise_sd: Float[Array, " output"]
) -> Information:
    """S' S / sigma^2, summed over time and outputs."""
    weighted = sensitivity / noise_sd[None, :, None]
    return jnp.einsum("koi,koj->ij", weighted, weighted)


def marginal_information(
    sensitivity: Float[Array, "time output unknown"],
    noise_sd: Float[Array, " output"],
    num_params: int,
) -> Information:
    """Information on the first `num_params` parameters when the others are unknown too.

    The others (an initial state) are eliminated by an orthogonal factorisation, which
    keeps the digits that a Schur complement of the information loses.
    """
    weighted = (sensitivity / noise_sd[None, :, None]).reshape(-1, sensitivity.shape[-1])
    columns = jnp.roll(weighted, -num_params, axis=1)
    num_others = columns.shape[1] - num_params
    # A direction of the others that the data do not see must not make the rest singular.
    prior = jnp.concatenate(
        [1e-6 * jnp.eye(num_others), jnp.zeros((num_others, num_params))], axis=1
    )
    R = jnp.linalg.qr(jnp.concatenate([columns, prior]), mode="r")[num_others:, num_others:]
    return R.T @ R


def experiment_information(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "time input"],
    *,
    initial_state_known: bool = True,
) -> Information:
    """Relative Fisher information of an experiment with these inputs and this plant's sensor.

    In logarithms of positive parameters, and of free ones over their scale.

    Args:
        initial_state_known: False where the initial state must be estimated along; the
            experiment starts at the plant's in either case.
    """
    require_double_precision()
    theta = jnp.stack([jnp.asarray(p, float) for p in params])
    size, num_params = relative_size(plant, params), len(theta)
    num_states = 0 if initial_state_known else len(plant.initial_state)

    def outputs(change: Array) -> Array:
        values = theta + size * change[:num_params]
        moved = change[num_params:] if num_states else 0.0
        return response(plant, plant.Params(*values), inputs, plant.initial_state + moved)

    S = sensitivity(outputs, jnp.zeros(num_params + num_states))
    if initial_state_known:
        return fisher_information(S, plant.sensor.sd)
    return marginal_information(S, plant.sensor.sd, num_params)


@eqx.filter_jit
def running_information(
    plant: AbstractPlant, params: Params, inputs: Float[Array, "time input"]
) -> Float[Array, "time param param"]:
    """What `experiment_information` is after each step, the initial state known.

    The last is that of the whole experiment.
    """
    theta, size = jnp.stack([jnp.asarray(p, float) for p in params]), relative_size(plant, params)

    def outputs(change: Array) -> Array:
        return response(plant, plant.Params(*(theta + size * change)), inputs)

    weighted = sensitivity(outputs, jnp.zeros(len(theta))) / plant.sensor.sd[None, :, None]
    each = jnp.einsum("koi,koj->kij", weighted, weighted)
    return jnp.cumsum(each, axis=0)[1:]


def relative_size(plant: AbstractPlant, params: Params) -> Float[Array, " param"]:
    """What one unit of relative information means for each parameter, in its unit."""
    return jnp.stack(
        [
            jnp.asarray(value if p.positive else p.scale, float)
            for p, value in zip(plant.definition.parameters, params, strict=True)
        ]
    )


def d_optimality(information: Information) -> Float[Array, ""]:
    """Log det M: minus twice the logarithm of the confidence ellipsoid's volume."""
    sign, value = jnp.linalg.slogdet(information)
    return jnp.where(sign > 0, value, -jnp.inf)


def a_optimality(information: Information) -> Float[Array, ""]:
    """Trace M^-1: the sum of the parameters' least variances."""
    return jnp.sum(cramer_rao_bound(information) ** 2)


def e_optimality(information: Information) -> Float[Array, ""]:
    """Smallest eigenvalue of M: the information in the direction seen worst."""
    return jnp.linalg.eigvalsh(information)[0]


def cramer_rao_bound(information: Information) -> Float[Array, " param"]:
    """Least standard deviation of each parameter; infinite where M is singular."""
    # Scaling to a unit diagonal first: parameters may differ by many orders of magnitude.
    size = jnp.sqrt(jnp.diagonal(information))
    safe = jnp.where(size > 0, size, 1.0)
    values, vectors = jnp.linalg.eigh(information / jnp.outer(safe, safe))
    unseen = values < 10 * len(size) * jnp.finfo(values.dtype).eps
    variance = jnp.sum(vectors**2 / jnp.where(unseen, 1.0, values)[None], axis=1) / safe**2
    lost = jnp.any(unseen[None] & (jnp.abs(vectors) > 1e-6), axis=1)
    return jnp.where(lost | (size == 0), jnp.inf, jnp.sqrt(variance))


def best_possible(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "time input"],
    *,
    initial_state_known: bool,
) -> dict[str, Any]:
    """Least standard deviation of each parameter for an input, as JSON-ready data.

    Raises:
        ValueError: for a sensor without noise, which sets no bound, and for a response
            that is not finite.
    """
    if not np.all(np.asarray(plant.sensor.sd) > 0):
        raise ValueError("a sensor without noise sets no bound; give every output a noise")
    information = experiment_information(
        plant, params, inputs, initial_state_known=initial_state_known
    )
    values = np.linalg.eigvalsh(np.nan_to_num(np.asarray(information)))
    if not np.all(np.isfinite(information)) or values[0] < -1e-6 * values[-1]:
        raise ValueError(
            "the response to this input is not finite, or chaotic: it has no information that "
            "could be trusted; a smaller amplitude or other parameters may help"
        )
    size = np.asarray(relative_size(plant, params))
    sd = np.asarray(cramer_rao_bound(information)) * size
    return {
        "plant": plant.definition.name,
        "initial_state": "known" if initial_state_known else "free",
        "params": {
            p.name: {
                "value": float(value),
                "cramer_rao_bound": float(s) if np.isfinite(s) else None,
                "cramer_rao_percent": float(100 * s / abs(value))
                if np.isfinite(s) and value
                else None,
                "unit": p.unit,
            }
            for p, value, s in zip(plant.definition.parameters, params, sd, strict=True)
        },
        "log_det_information": float(d_optimality(information)),
        "a_optimality": float(a_optimality(information)),
        "e_optimality": float(e_optimality(information)),
        "information": np.asarray(information),
        "verdict": _verdict(names_of(plant.definition.parameters), np.asarray(information)),
    }


def _verdict(names: tuple[str, ...], information: np.ndarray) -> list[str]:
    """What cannot be seen, one sentence each, and how well the rest is."""
    free, sentences = np.ones(len(names), bool), []
    while (unseen := worst_seen(names, information, free)) is not None:
        free[unseen[0]] = False
        sentences.append(unseen[1])
    if free.any():
        block = np.where(np.outer(free, free), information, np.eye(len(names)))
        sentences.append(identifiability(names, np.linalg.inv(block), free))
    return sentences


def worst_seen(
    names: tuple[str, ...], information: Float[np.ndarray, "param param"], free: np.ndarray
) -> tuple[int, str] | None:
    """The free parameter to hold because the data do not see it, and why, in words.

    None when every direction of the free parameters is known better than `UNSEEN_SD`.
    The direction is the eigenvector of the information with the smallest eigenvalue.
    """
    index = np.flatnonzero(free)
    if index.size == 0:
        return None
    block = information[np.ix_(index, index)]
    if np.all(np.isfinite(block)):
        values, vectors = np.linalg.eigh(block)
        value, direction = max(values[0], 0.0), vectors[:, 0]
    else:
        value, direction = 0.0, np.ones(index.size)
    if value * UNSEEN_SD**2 >= 1:
        return None
    chosen = int(index[np.argmax(np.abs(direction))])
    involved = [names[i] for i, v in zip(index, direction, strict=True) if abs(v) > 0.3]
    if len(involved) == 1:
        return chosen, f"the data cannot see {names[chosen]}"
    combination = " ".join(
        f"{names[i]}^{v:+.2g}"
        for i, v in zip(index, direction / direction[np.argmax(np.abs(direction))], strict=True)
        if names[i] in involved
    )
    return chosen, (
        f"the data cannot tell {' and '.join(involved)} apart: {combination} could have any size"
    )


def identifiability(
    names: tuple[str, ...], covariance: Float[np.ndarray, "param param"], free: np.ndarray
) -> str:
    """How well the worst direction of the free parameters is seen, in words.

    Args:
        covariance: of relative changes.
    """
    index = np.flatnonzero(free)
    values, vectors = np.linalg.eigh(covariance[np.ix_(index, index)])
    sd, direction = np.sqrt(max(values[-1], 0.0)), vectors[:, -1]
    involved = [names[i] for i, v in zip(index, direction, strict=True) if abs(v) > 0.3]
    what = involved[0] if len(involved) == 1 else f"a combination of {' and '.join(involved)}"
    seen = ", ".join(names[i] for i in index)
    return f"the data see all of {seen}; worst is {what}, to {100 * sd:.2g} %"
