"""The contract of an estimator: from experiments to parameters with a covariance.

Estimators are pure: failure is a `Status`, counted by a benchmark and turned into a
sentence at the door.
"""

from __future__ import annotations

import abc
import enum
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..description import PlantDescription
from ..plant import AbstractPlant, Params
from ..simulation import simulate


class Status(enum.IntEnum):
    """How an estimation ended; anything but SUCCESSFUL is a failed estimate."""

    SUCCESSFUL = 0
    ILL_CONDITIONED = 1
    UNPHYSICAL = 2
    NOT_FINITE = 3
    ITERATIONS_EXHAUSTED = 4

    @property
    def sentence(self) -> str:
        """The status in words."""
        return {
            Status.SUCCESSFUL: "successful",
            Status.ILL_CONDITIONED: "the data do not determine all parameters",
            Status.UNPHYSICAL: "the ARX model has no physical counterpart "
            "(a pole is negative real or not inside the unit circle)",
            Status.NOT_FINITE: "the estimate is not finite",
            Status.ITERATIONS_EXHAUSTED: "the search did not converge",
        }[self]


class Experiments(eqx.Module):
    """One or several experiments of one plant, padded to one length.

    Attributes:
        inputs: row k is held from sample k to k + 1.
        measured: measured outputs.
        valid: False where an experiment was padded.
        initial_state: known, or where the search for it begins.
        initial_state_known: whether it is estimated along.
    """

    inputs: Float[Array, "experiment time input"]
    measured: Float[Array, "experiment time+1 output"]
    valid: Bool[Array, "experiment time+1"]
    initial_state: Float[Array, "experiment state"]
    initial_state_known: bool = eqx.field(static=True)


def stack_experiments(
    plant: AbstractPlant,
    inputs: Sequence[Float[Array, "_time input"]],
    measured: Sequence[Float[Array, "_samples output"]],
    initial_state_known: bool,
) -> Experiments:
    """Experiments of any lengths side by side; each has one more output than inputs."""
    longest = max(len(u) for u in inputs)

    def padded(rows: Array, length: int) -> Array:
        return jnp.pad(jnp.asarray(rows, float), ((0, length - len(rows)), (0, 0)))

    counts = jnp.asarray([len(y) for y in measured])
    return Experiments(
        inputs=jnp.stack([padded(u, longest) for u in inputs]),
        measured=jnp.stack([padded(y, longest + 1) for y in measured]),
        valid=jnp.arange(longest + 1)[None] < counts[:, None],
        initial_state=jnp.tile(plant.initial_state, (len(inputs), 1)),
        initial_state_known=initial_state_known,
    )


class Estimate(eqx.Module):
    """What an estimator returns.

    Attributes:
        params: estimated parameters.
        covariance: of `params` (held parameters: zero rows).
        information: inverse covariance in search coordinates, where parameters are
            comparable: logarithms of positive ones, free ones over their scale.
        status: a `Status`.
        initial_state: known or estimated.
        residual: measured minus simulated outputs, zero where padded.
    """

    params: Params
    covariance: Float[Array, "param param"]
    information: Float[Array, "param param"]
    status: Int[Array, ""]
    initial_state: Float[Array, "experiment state"]
    residual: Float[Array, "experiment time+1 output"]


class AbstractEstimator(eqx.Module):
    """Base of all estimators; `name` is its word on the command line."""

    name: ClassVar[str]

    @abc.abstractmethod
    def __call__(
        self,
        plant: AbstractPlant,
        experiments: Experiments,
        start: Params | None = None,
        free: Bool[Array, " param"] | None = None,
    ) -> Estimate:
        """Estimate of the plant's parameters.

        Args:
            plant: its constants, sensor and sampling time are taken as known.
            experiments: the data.
            start: where a search begins, default the nominal parameters.
            free: False for a parameter that is held at `start`; default all free.
        """


def simulate_experiments(
    plant: AbstractPlant,
    params: Params,
    experiments: Experiments,
    initial_state: Float[Array, "experiment state"],
) -> Float[Array, "experiment time+1 output"]:
    """Noise-free outputs of all experiments for one set of parameters."""
    return jax.vmap(simulate, in_axes=(None, None, 0, 0))(
        plant, params, experiments.inputs, initial_state
    )


def residual_of(
    experiments: Experiments, simulated: Float[Array, "experiment time+1 output"]
) -> Float[Array, "experiment time+1 output"]:
    """Measured minus simulated outputs, zero where padded."""
    return jnp.where(experiments.valid[..., None], experiments.measured - simulated, 0.0)


_WIDE = 1e6  # of one-sided bounds: the other side lies this factor (or many scales) away


def _coordinate_bounds(description: PlantDescription) -> tuple[np.ndarray, ...]:
    """Scale, lower and upper bound of each parameter before the bounded transformation."""
    scale, lower, upper = [], [], []
    for p in description.parameters:
        unit, centre = (1.0, np.log(p.nominal)) if p.positive else (p.scale, p.nominal)
        far = np.log(_WIDE) if p.positive else _WIDE * unit

        def coordinate(bound: float, positive: bool = p.positive) -> float:
            return float(np.log(bound)) if positive else bound

        unbounded = p.lower is None and p.upper is None
        scale.append(unit)
        lower.append(
            -np.inf if unbounded else centre - far if p.lower is None else coordinate(p.lower)
        )
        upper.append(
            np.inf if unbounded else centre + far if p.upper is None else coordinate(p.upper)
        )
    return np.array(scale), np.array(lower), np.array(upper)


def to_search(description: PlantDescription, params: Params) -> Float[Array, " param"]:
    """Search coordinates: log of positive parameters, free ones over their scale.

    A bounded parameter passes through a logistic function as well, so that the search
    never leaves its bounds.
    """
    scale, lower, upper = _coordinate_bounds(description)
    positive = np.array([p.positive for p in description.parameters])
    values = jnp.stack([jnp.asarray(p, float) for p in params])
    c = jnp.where(positive, jnp.log(jnp.where(positive, values, 1.0)), values)
    bounded = np.isfinite(lower)
    low, width = np.where(bounded, lower, 0.0), np.where(bounded, upper - lower, 1.0)
    fraction = jnp.where(bounded, (c - low) / width, 0.5)
    return jnp.where(bounded, width / 4 * jnp.log(fraction / (1 - fraction)), c) / scale


def from_search(description: PlantDescription, z: Float[Array, " param"]) -> Array:
    """Parameters, as a vector, at search coordinates `z`; the inverse of `to_search`."""
    scale, lower, upper = _coordinate_bounds(description)
    positive = np.array([p.positive for p in description.parameters])
    bounded = np.isfinite(lower)
    low, width = np.where(bounded, lower, 0.0), np.where(bounded, upper - lower, 1.0)
    c = jnp.where(bounded, low + width * jax.nn.sigmoid(4 * z * scale / width), z * scale)
    return jnp.where(positive, jnp.exp(jnp.where(positive, c, 0.0)), c)


def search_slope(description: PlantDescription, params: Params) -> Float[Array, " param"]:
    """Derivative of each parameter with respect to its own search coordinate."""
    z = to_search(description, params)
    return jnp.diagonal(jax.jacfwd(lambda z: from_search(description, z))(z))


def bound_reached(description: PlantDescription, params: Params) -> tuple[int, float] | None:
    """Index and bound of the first parameter that ended at one; None where none did."""
    for i, (p, value) in enumerate(zip(description.parameters, params, strict=True)):
        for bound, other in ((p.lower, p.upper), (p.upper, p.lower)):
            if bound is None:
                continue
            width = p.scale if other is None else abs(other - bound)
            if abs(float(value) - bound) < 1e-3 * width:
                return i, bound
    return None
