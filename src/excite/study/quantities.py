"""Quantities that depend on a plant's parameters, and how precisely they are known.

A quantity is a parameter, a function of the parameters, or an output that is predicted for an
experiment. Its interval follows from that of the parameters by the first derivative (delta method;
G. Seber, C. Wild, Nonlinear Regression, 1989, section 5.1).
"""

from __future__ import annotations

import abc
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..description import HALF_95, PlantDescription, names_of, told, unknown
from ..estimation.result import Identification
from ..excitation.catalogue import excitation_named
from ..excitation.contract import AbstractSignal
from ..files import function_at, is_class_word
from ..information import relative_size
from ..plant import AbstractPlant, Params
from ..rig.contract import Interval
from ..simulation import response

QuantityLike: TypeAlias = str | Callable[[Any], Any]
"""A parameter's name, a function of the parameters, `path/to/file.py:function`, or a prediction
`OUTPUT@SECONDS:SIGNAL` such as `pitch@2:step.csv`."""

_LONGEST = 1_000_000  # samples of a prediction
_PREDICTION = re.compile(r"(?P<output>[^@:]+)@(?P<time>[^:]+):(?P<signal>.+)")


class AbstractQuantity(eqx.Module):
    """A number that depends on the parameters.

    Attributes:
        name: in tables.
        unit: of the number.
    """

    name: eqx.AbstractVar[str]
    unit: eqx.AbstractVar[str]

    @abc.abstractmethod
    def __call__(self, plant: AbstractPlant, params: Params) -> Float[Array, ""]:
        """The number."""


class OneParameter(AbstractQuantity):
    """A parameter itself."""

    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)

    def __call__(self, plant: AbstractPlant, params: Params) -> Float[Array, ""]:
        """Its value."""
        return jnp.asarray(getattr(params, self.name), float)


class FunctionOfParameters(AbstractQuantity):
    """A user's function of the parameters, in JAX's operations."""

    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    function: Callable[[Params], Any] = eqx.field(static=True)

    def __call__(self, plant: AbstractPlant, params: Params) -> Float[Array, ""]:
        """Its value; ValueError where it is not one number."""
        value = jnp.asarray(self.function(params), float)
        if value.shape:
            raise ValueError(f"got an array of shape {value.shape}")
        return value


class PredictedOutput(AbstractQuantity):
    """An output at the end of an experiment from rest.

    Attributes:
        index: of the output.
        inputs: of the experiment, in the inputs' units.
    """

    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    index: int = eqx.field(static=True)
    inputs: Float[Array, "time input"]

    def __call__(self, plant: AbstractPlant, params: Params) -> Float[Array, ""]:
        """Its noise-free value."""
        return response(plant, params, self.inputs)[-1, self.index]


def parameters_of(plant: PlantDescription) -> tuple[OneParameter, ...]:
    """All parameters of a plant, in order."""
    return tuple(OneParameter(p.name, p.unit) for p in plant.parameters)


def quantity_of(plant: AbstractPlant, given: QuantityLike) -> AbstractQuantity:
    """What a user named.

    Raises:
        ValueError: for an unknown name, a file without such a function, a function that gives no
            finite number at the nominal parameters, and an experiment that is too short.
    """
    if not isinstance(given, str):
        return _function(plant, getattr(given, "__name__", type(given).__name__), given)
    d = plant.description
    if (found := _PREDICTION.fullmatch(given)) is not None:
        return _prediction(plant, given, **found.groupdict())
    path, _, word = given.rpartition(":")
    if is_class_word(given):
        return _function(plant, word, function_at(Path(path), word))
    if "@" in given or given.endswith((".py", ".py:")):
        raise ValueError(
            f"{given!r} is no quantity: a prediction is OUTPUT@SECONDS:SIGNAL, such as "
            "pitch@2:step.csv, a function path/to/file.py:function"
        )
    if given not in names_of(d.parameters):
        raise unknown("parameter", given, names_of(d.parameters))
    return OneParameter(given, d.parameter(given).unit)


def _function(
    plant: AbstractPlant, name: str, function: Callable[[Params], Any]
) -> FunctionOfParameters:
    """A user's function; its attribute `unit` is that of the number, if there is one."""
    if name in names_of(plant.definition.parameters) or name == "<lambda>":
        raise ValueError(f"a function needs a name of its own: got {name!r}")
    found = FunctionOfParameters(name, str(getattr(function, "unit", "")), function)
    require_defined(found, plant)
    return found


def require_defined(
    quantity: AbstractQuantity, plant: AbstractPlant, params: Params | None = None
) -> None:
    """Raises ValueError unless the quantity is a finite number with a slope.

    Args:
        quantity: of the plant.
        plant: whose parameters are meant.
        params: default the nominal ones.
    """
    where, at = f"{quantity.name} of {plant.definition.name!r}", "the nominal parameters"
    if params is not None:
        at = "the estimate"
    try:
        value, slope = map(np.asarray, slopes((quantity,), plant, params or plant.nominal))
    except BaseException as error:  # of the user's function, also sys.exit
        if isinstance(error, KeyboardInterrupt):
            raise
        raise ValueError(
            f"{where} must compute one number with jax.numpy from the parameters: {told(error)}"
        ) from error
    if not (np.isfinite(value).all() and np.isfinite(slope).all()):
        raise ValueError(f"{where} is no finite number, or has no finite slope, at {at}")
    if not np.any(slope):
        raise ValueError(f"{where} has no slope at {at}: its interval cannot be told")


def _prediction(
    plant: AbstractPlant, name: str, output: str, time: str, signal: str
) -> PredictedOutput:
    """An output at a time of an experiment from rest."""
    d, dt = plant.description, float(plant.dt)
    names = names_of(d.outputs)
    if output not in names:
        raise unknown("output", output, names)
    try:
        count = round(float(time.strip().removesuffix("s")) / dt)
    except (ValueError, OverflowError):
        count = 0
    if not 0 < count <= _LONGEST:
        raise ValueError(
            f"{name}: the time must be a number of seconds from {dt:g} to {_LONGEST * dt:g}: got "
            f"{time!r}"
        )
    try:
        excitation = excitation_named(signal, {}, plant)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    if not isinstance(excitation, AbstractSignal):
        raise ValueError(f"{name}: a prediction needs a signal that does not react: got {signal!r}")
    try:
        inputs = excitation.sequence(plant, count, jax.random.key(0))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    found = PredictedOutput(name, d.outputs[names.index(output)].unit, names.index(output), inputs)
    require_defined(found, plant)
    return found


@eqx.filter_jit
def slopes(
    quantities: Sequence[AbstractQuantity], plant: AbstractPlant, params: Params
) -> tuple[Float[Array, " quantity"], Float[Array, "quantity param"]]:
    """The numbers, and their derivatives with respect to the parameters, in their units."""
    theta = jnp.stack([jnp.asarray(value, float) for value in params])

    def of(theta: Array) -> Array:
        return jnp.stack([quantity(plant, plant.Params(*theta)) for quantity in quantities])

    return of(theta), jax.jacfwd(of)(theta)


def half_intervals(
    quantities: Sequence[AbstractQuantity],
    plant: AbstractPlant,
    params: Params,
    information: Float[Array, "*step param param"],
) -> Float[Array, "*step quantity"]:
    """Half of the 95 % intervals, in the quantities' units; infinite for singular information.

    Args:
        quantities: of the plant.
        plant: whose parameters are meant.
        params: where the derivatives are taken.
        information: relative Fisher information of the parameters.
    """
    inverse = jnp.linalg.inv(information)
    slope = slopes(quantities, plant, params)[1] * relative_size(plant, params)[None]
    variance = jnp.einsum("qi,...ij,qj->...q", slope, inverse, slope)
    sound = jnp.isfinite(variance) & (variance > 0)
    return HALF_95 * jnp.sqrt(jnp.where(sound, variance, jnp.inf))


def propagated(
    quantities: Sequence[AbstractQuantity],
    plant: AbstractPlant,
    params: Params,
    covariance: Float[np.ndarray, "param param"],
    halves: Float[np.ndarray, " param"],
) -> dict[str, Interval]:
    """Of each quantity, its value with half of the 95 % interval, from those of the parameters.

    Args:
        quantities: of the plant.
        plant: whose parameters are meant.
        params: the estimates.
        covariance: of the estimates.
        halves: of the parameters' 95 % intervals; infinite for one that is not known.
    """
    if not quantities:
        return {}
    values, slope = map(np.asarray, slopes(quantities, plant, params))
    sd = np.sqrt(np.diag(covariance))
    is_known = np.isfinite(halves) & np.isfinite(sd) & (sd > 0)
    root = np.where(is_known, halves, 0.0) / np.where(is_known, sd, 1.0)
    scaled = np.where(is_known[:, None] & is_known[None], covariance, 0.0) * np.outer(root, root)
    half = np.sqrt(np.maximum(np.einsum("qi,ij,qj->q", slope, scaled, slope), 0.0))
    half = np.where((slope[:, ~np.isfinite(halves)] != 0).any(axis=1), np.inf, half)
    each = zip(quantities, values, half, strict=True)
    return {q.name: Interval(float(value), float(own)) for q, value, own in each}


def known_of(
    plant: AbstractPlant, result: Identification, others: Sequence[AbstractQuantity] = ()
) -> dict[str, Interval]:
    """Of each parameter and each of some other quantities, the estimate and half of its interval.

    The interval is infinite for a held parameter.
    """
    found = {}
    for name, value in result.params.items():
        low, high = result.ci95(name)
        half = float("inf") if name in result.held else (high - low) / 2
        found[name] = Interval(float(value), half if half == half else float("inf"))
    halves = np.array([interval.ci95_half for interval in found.values()])
    params = plant.Params(*(jnp.asarray(interval.estimate, float) for interval in found.values()))
    return found | propagated(others, plant, params, result.covariance, halves)


def estimates(known: Mapping[str, Interval], plant: AbstractPlant) -> Params:
    """The plant's parameters among what is known."""
    return plant.Params(
        *(jnp.asarray(known[name].estimate, float) for name in plant.nominal._fields)
    )
