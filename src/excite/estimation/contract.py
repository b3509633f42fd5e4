"""The contract of an estimator: from experiments to parameters with a covariance.

Estimators are pure. A failure is a `Status`: a study counts it, and the entry points report
it as a sentence.
"""

from __future__ import annotations

import abc
import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..description import PlantDescription, names_of
from ..information import relative_size
from ..plant import AbstractPlant, Params, Sensor
from ..simulation import response

AnyArray: TypeAlias = Array | np.ndarray


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
            "(a pole is negative real or not inside the unit circle, or a parameter negative)",
            Status.NOT_FINITE: "the estimate is not finite",
            Status.ITERATIONS_EXHAUSTED: "the search did not converge",
        }[self]


class Experiments(eqx.Module):
    """One or several experiments of one plant, padded to one length.

    Attributes:
        inputs: row k acts from sample k to k + 1, and with feedthrough on sample k.
        measured: measured outputs, one row more than inputs. With feedthrough the last one is
            padded, because the last measured sample needs an input.
        valid: False where an output was not measured or an experiment was padded.
        initial_state: known, or the start of its search.
        initial_state_known: False where it is estimated too.
        dt: time from each sample to the next [s]; None: the plant's sampling time.
        next_inputs: inputs at sample k + 1, if they are linear in between; None: they are held.
    """

    inputs: Float[Array, "experiment time input"]
    measured: Float[Array, "experiment sample output"]
    valid: Bool[Array, "experiment sample output"]
    initial_state: Float[Array, "experiment state"]
    initial_state_known: bool = eqx.field(static=True)
    dt: Float[Array, "experiment time"] | None = None
    next_inputs: Float[Array, "experiment time input"] | None = None

    def padded(self, count: int, num_samples: int) -> Experiments:
        """With samples and experiments in which nothing was measured, up to these numbers.

        Programs that were compiled for them serve all smaller sets of experiments.
        """
        more, longer = max(0, count - len(self.valid)), max(0, num_samples - self.valid.shape[1])
        if not (more or longer):
            return self

        def wider(rows: Array) -> np.ndarray:
            if rows is self.initial_state:
                return np.pad(rows, [(0, more), (0, 0)], mode="edge")
            return np.pad(rows, [(0, more), (0, longer), *[(0, 0)] * (rows.ndim - 2)])

        return jax.device_put(jax.tree.map(wider, self))


def stack_experiments(
    plant: AbstractPlant,
    inputs: Sequence[Float[Array, "_time input"] | Float[np.ndarray, "_time input"]],
    measured: Sequence[Float[Array, "_samples output"] | Float[np.ndarray, "_samples output"]],
    initial_state_known: bool,
    *,
    dt: Sequence[Float[np.ndarray, " _time"]] | None = None,
    next_inputs: Sequence[Float[np.ndarray, "_time input"]] | None = None,
    seen: Sequence[Bool[np.ndarray, "_samples output"]] | None = None,
) -> Experiments:
    """Experiments of any lengths side by side; each has one more output than inputs.

    With feedthrough, the last row of inputs is that of the last sample; where inputs have one row
    less than the outputs, it is repeated.

    Args:
        dt: see `Experiments`.
        next_inputs: see `Experiments`.
        seen: False where an output was not measured; its value is ignored.
    """
    xp = jnp if any(isinstance(rows, jax.core.Tracer) for rows in (*inputs, *measured)) else np
    if plant.has_feedthrough:

        def with_last(u: AnyArray, y: AnyArray) -> AnyArray:
            return u if len(u) == len(y) else xp.concatenate([u, u[-1:]])

        inputs = [*map(with_last, inputs, measured)]
    longest, counts = max(map(len, inputs)), xp.asarray([len(y) for y in measured])

    def stacked(records: Sequence[AnyArray], length: int) -> AnyArray:
        padded = [
            rows
            if len(rows) == length
            else xp.pad(rows, [(0, length - len(rows)), *[(0, 0)] * (rows.ndim - 1)])
            for rows in (xp.asarray(rows, float) for rows in records)
        ]
        return xp.stack(padded)

    valid = xp.arange(longest + 1)[None, :, None] < counts[:, None, None]
    valid = xp.tile(valid, (1, 1, measured[0].shape[1]))
    if seen is not None:
        valid = valid & (stacked(seen, longest + 1) > 0)
        measured = [xp.where(own, rows, 0.0) for own, rows in zip(seen, measured, strict=True)]
    arrays = {
        "inputs": stacked(inputs, longest),
        "measured": stacked(measured, longest + 1),
        "valid": valid,
        "initial_state": xp.tile(xp.asarray(plant.initial_state), (len(inputs), 1)),
        "dt": None if dt is None else stacked(dt, longest),
        "next_inputs": None if next_inputs is None else stacked(next_inputs, longest),
    }
    arrays = jax.device_put(arrays) if xp is np else arrays
    return Experiments(**arrays, initial_state_known=initial_state_known)


def transitions(
    plant: AbstractPlant, experiments: Experiments
) -> tuple[AbstractPlant, Experiments]:
    """Every step of a plant whose state is observed, as an experiment of its own.

    It begins with the state that is measured, and ends with a measurement whose noise is that of
    the process: the likelihood of the experiments is that of their transitions.

    Raises:
        ValueError: for an input delay, with which the state is not all that the plant remembers,
            and for steps of different length, which have different noise.
    """
    e = experiments
    if e.dt is not None or plant.delay(plant.nominal) is not None:
        what = "times are uneven" if e.dt is not None else "an input is delayed"
        raise ValueError(
            f"{what}, and plant {plant.definition.name!r} has process noise in every step: use the "
            "estimator pem"
        )

    def steps(rows: Array) -> Array:
        return rows.reshape(-1, 1, rows.shape[2])

    measured = jnp.concatenate([steps(e.measured[:, :-1]), steps(e.measured[:, 1:])], axis=1)
    after = e.valid[:, 1:] & e.valid[:, :-1].all(axis=2, keepdims=True)
    valid = jnp.concatenate([jnp.zeros_like(steps(after)), steps(after)], axis=1)
    own = plant.changed(sensor=Sensor(plant.process_noise_sd, jnp.zeros(after.shape[2])))
    return own, Experiments(
        inputs=steps(e.inputs),
        measured=measured,
        valid=valid,
        initial_state=measured[:, 0],
        initial_state_known=True,
        next_inputs=None if e.next_inputs is None else steps(e.next_inputs),
    )


def of_transitions(
    experiments: Experiments, values: Float[Array, "step 2 output"]
) -> Float[Array, "experiment sample output"]:
    """Values of the ends of all `transitions`, by experiment; NaN at its first sample."""
    shape = experiments.measured.shape
    ends = values[:, 1].reshape(shape[0], -1, shape[2])
    return jnp.concatenate([jnp.full_like(ends[:, :1], jnp.nan), ends], axis=1)


class Prediction(eqx.Module):
    """One-step prediction of the outputs of a plant that is disturbed.

    Attributes:
        outputs: predicted from all earlier samples.
        sd: of measured minus predicted outputs.
        process_noise: diffusion of each state [state unit / sqrt(s)].
        noise_sd: of the sensors [output unit].
    """

    outputs: Float[Array, "experiment sample output"]
    sd: Float[Array, "experiment sample output"]
    process_noise: Float[Array, " state"]
    noise_sd: Float[Array, " output"]


class Estimate(eqx.Module):
    """What an estimator returns.

    Attributes:
        params: estimated parameters.
        covariance: of `params` (held parameters: zero rows).
        information: of relative changes: logarithms of positive parameters, free ones over
            their scale. The inverse of their covariance, where every output was weighted by
            its noise.
        status: a `Status`.
        initial_state: known or estimated.
        residual: measured minus simulated outputs, or minus predicted ones where there is a
            prediction; zero where padded.
        cost: weighted sum of squares at the end of a search; infinite where there is none.
        steps: of the search.
        degrees: degrees of freedom of Student's t for each parameter's interval, infinite where
            the noise is known; None counts as infinite.
        prediction: of estimators that take the plant as disturbed.
    """

    params: Params
    covariance: Float[Array, "param param"]
    information: Float[Array, "param param"]
    status: Int[Array, ""]
    initial_state: Float[Array, "experiment state"]
    residual: Float[Array, "experiment sample output"]
    cost: Float[Array, ""] | float = math.inf
    steps: Int[Array, ""] | int = 0
    degrees: Float[Array, " param"] | None = None
    prediction: Prediction | None = None

    def of(self, padded: Experiments) -> Estimate:
        """The same of experiments that were `padded`."""
        sizes = zip(padded.valid.shape, self.residual.shape, strict=True)
        longer = [(0, new - own) for new, own in sizes]
        state = np.pad(self.initial_state, [longer[0], (0, 0)], mode="edge")
        rows = state, np.pad(self.residual, longer)
        return eqx.tree_at(lambda e: (e.initial_state, e.residual), self, rows)


@dataclass(frozen=True)
class Basis:
    """What an identification was computed from.

    Attributes:
        plant: as it was fitted.
        experiments: the records.
        estimator: as it was called.
        estimate: what it returned.
        free: False for a parameter that was held.
        uncertain: standard deviation of each known constant, or zero.
    """

    plant: AbstractPlant
    experiments: Experiments
    estimator: AbstractEstimator
    estimate: Estimate
    free: Bool[np.ndarray, " param"]
    uncertain: Float[np.ndarray, " constant"]


def quality(estimate: Estimate) -> float:
    """The cost, smaller is better; of two alike a successful estimate counts more."""
    cost = float(estimate.cost) * (1.0 if int(estimate.status) == Status.SUCCESSFUL else 1.01)
    return cost if math.isfinite(cost) else math.inf


class AbstractEstimator(eqx.Module):
    """Base of all estimators; `name` is used on the command line.

    `needs` says in words what a record must have; it is shown with a failed estimate.
    """

    name: eqx.AbstractVar[str]
    needs: ClassVar[str] = ""

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


class AbstractSearch(AbstractEstimator):
    """Base of estimators that search from a start, with some parameters free and others held.

    They take records as they are: uneven times, missing outputs, inputs that are linear
    between samples. `known` names the parameters that are held where the search starts.
    """

    known: eqx.AbstractVar[tuple[str, ...]]

    def held(self, plant: AbstractPlant) -> tuple[bool, ...]:
        """Which parameters of a plant are held; ValueError for a name it does not have."""
        names = names_of(plant.definition.parameters)
        for name in self.known:
            if name not in names:
                raise ValueError(
                    f"plant {plant.definition.name!r} has no parameter {name!r} to hold; it has "
                    f"{', '.join(names)}"
                )
        return tuple(name in self.known for name in names)

    def freed(self, plant: AbstractPlant, free: Bool[Array, " param"] | None) -> Array:
        """Which parameters are searched: those of `free`, default all, that are not held."""
        others = ~jnp.asarray(self.held(plant))
        return others if free is None else free & others


def simulate_experiments(
    plant: AbstractPlant,
    params: Params,
    experiments: Experiments,
    initial_state: Float[Array, "experiment state"],
) -> Float[Array, "experiment sample output"]:
    """Noise-free outputs of all experiments for one set of parameters."""
    e = experiments
    return jax.vmap(response, in_axes=(None, None, 0, 0, 0, 0))(
        plant, params, e.inputs, initial_state, e.dt, e.next_inputs
    )


def residual_of(
    experiments: Experiments, simulated: Float[Array, "experiment sample output"]
) -> Float[Array, "experiment sample output"]:
    """Measured minus simulated outputs, zero where padded."""
    return jnp.where(experiments.valid, experiments.measured - simulated, 0.0)


def status_of(plant: AbstractPlant, params: Params, status: Int[Array, ""]) -> Int[Array, ""]:
    """The status of an estimate, after a check that its parameters are finite and valid."""
    values = jnp.stack(params)
    positive = np.array([p.positive for p in plant.definition.parameters])
    status = jnp.where(jnp.any(positive & (values <= 0)), Status.UNPHYSICAL, status)
    finite = jnp.all(jnp.isfinite(values))
    return jnp.where(finite, status, Status.NOT_FINITE)


def relative_information(
    plant: AbstractPlant, params: Params, covariance: Float[Array, "param param"]
) -> Float[Array, "param param"]:
    """Information of relative changes, as in an estimate, from a covariance of `params`."""
    size = relative_size(plant, params)
    return jnp.linalg.inv(covariance / jnp.outer(size, size))


class _Bounds:
    """Bounds of all parameters in units of relative change: logarithms, or over the scale."""

    def __init__(self, description: PlantDescription) -> None:
        parts = description.parameters
        self.positive = np.array([p.positive for p in parts])
        self.scale = np.array([1.0 if p.positive else p.scale for p in parts])

        def relative(value: float | None, positive: bool, scale: float) -> float:
            if value is None:
                return np.nan
            return float(np.log(value)) if positive else value / scale

        pairs = list(zip(parts, self.scale, strict=True))
        lower = np.array([relative(p.lower, p.positive, scale) for p, scale in pairs])
        upper = np.array([relative(p.upper, p.positive, scale) for p, scale in pairs])
        self.has_lower, self.has_upper = np.isfinite(lower), np.isfinite(upper)
        self.both = self.has_lower & self.has_upper
        self.lower, self.upper = np.nan_to_num(lower), np.nan_to_num(upper)
        self.width = np.where(self.both, self.upper - self.lower, 1.0)

    def relative(self, values: AnyArray) -> AnyArray:
        """Logarithms of positive parameters, free ones over their scale."""
        xp = jnp if isinstance(values, jax.Array) else np
        logarithm = xp.log(xp.where(self.positive, values, 1.0))
        return xp.where(self.positive, logarithm, values / self.scale)


@partial(jax.jit, static_argnums=0)
def to_search(description: PlantDescription, params: Params) -> Float[Array, " param"]:
    """Search coordinates: log of positive parameters, free ones over their scale.

    A bounded parameter passes through a logistic function as well (a soft ramp, where it
    has one bound only), so that the search never leaves its bounds.
    """
    b = _Bounds(description)
    c = jnp.asarray(b.relative(jnp.stack([jnp.asarray(p, float) for p in params])))
    if not np.any(b.has_lower | b.has_upper):
        return c
    fraction = jnp.where(b.both, (c - b.lower) / b.width, 0.5)
    between = b.width / 4 * (jnp.log(fraction) - jnp.log1p(-fraction))
    above = jnp.where(b.has_lower, c - b.lower, 1.0)
    below = jnp.where(b.has_upper, b.upper - c, 1.0)
    one_sided = jnp.where(b.has_lower, _inverse_ramp(above), -_inverse_ramp(below))
    bounded = jnp.where(b.both, between, one_sided)
    return jnp.where(b.has_lower | b.has_upper, bounded, c)


def _inverse_ramp(value: Array) -> Array:
    """Inverse of log(1 + exp(x)), the soft ramp."""
    return value + jnp.log(-jnp.expm1(-value))


@partial(jax.jit, static_argnums=0)
def from_search(description: PlantDescription, z: Float[Array, " param"]) -> Array:
    """Parameters, as a vector, at search coordinates `z`; the inverse of `to_search`."""
    b = _Bounds(description)
    if not np.any(b.has_lower | b.has_upper):
        return jnp.where(b.positive, jnp.exp(jnp.where(b.positive, z, 0.0)), z * b.scale)
    between = b.lower + b.width * jax.nn.sigmoid(4 * z / b.width)
    one_sided = jnp.where(b.has_lower, b.lower + jax.nn.softplus(z), b.upper - jax.nn.softplus(-z))
    bounded = jnp.where(b.both, between, one_sided)
    c = jnp.where(b.has_lower | b.has_upper, bounded, z)
    return jnp.where(b.positive, jnp.exp(jnp.where(b.positive, c, 0.0)), c * b.scale)


def bound_reached(description: PlantDescription, params: Params) -> tuple[int, float] | None:
    """Index and bound of the first parameter at a bound; None where there is none."""
    b = _Bounds(description)
    c = b.relative(np.array([float(p) for p in params]))
    for i, p in enumerate(description.parameters):
        margin = 1e-3 * b.width[i]
        if p.lower is not None and c[i] - b.lower[i] < margin:
            return i, p.lower
        if p.upper is not None and b.upper[i] - c[i] < margin:
            return i, p.upper
    return None
