"""The contract of a plant: an ordinary differential equation and its description.

A new plant is one class with a `definition` (plain data) and two pure functions:

    x'(t) = derivative(x, u, params)        y(t) = output(x, params)

Simulation, sensitivities, estimation and training need nothing else. Outputs on which an input
acts at once, as on an accelerometer, are output(x, u, params). Numbers of a plant
are leaves of the pytree, names and limits are static. Two plants of a class that differ
in a constant, in sensor noise or in the initial state share one compilation.
"""

from __future__ import annotations

import abc
import copy
import dataclasses
import inspect
import math
from collections import namedtuple
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..description import (
    Parameter,
    PlantDescription,
    Spread,
    SpreadLike,
    as_number,
    by_name,
    names_of,
    unknown,
    wrong_type,
)
from .fields import floats

# Estimation and information need double precision. Every computation imports this module,
# so JAX is switched here and nowhere else; processes of a pool are told before they start.
jax.config.update("jax_enable_x64", True)
# Handing a program over to another thread would cost up to a third of a short fit.
jax.config.update("jax_cpu_enable_async_dispatch", False)


def require_double_precision() -> None:
    """Raises ValueError where JAX was switched back to single precision."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            "estimation and information need double precision: "
            'call jax.config.update("jax_enable_x64", True) first'
        )


_Plant = TypeVar("_Plant", bound="AbstractPlant")
Params: TypeAlias = Any
"""The unknown parameters: a named tuple of scalars in the order of the description."""


@cache
def _tuple_type(title: str, names: tuple[str, ...]) -> type:
    # One class for one set of names: a pytree of another class would compile again.
    return namedtuple(title, names)  # pyright: ignore[reportUntypedNamedTuple]


@cache
def _takes_input(kind: type[AbstractPlant]) -> bool:
    needed = [p for p in inspect.signature(kind.output).parameters.values() if p.default is p.empty]
    return len(needed) == len(("self", "state", "input", "params"))


class Sensor(eqx.Module):
    """Sensor of all outputs: Gaussian noise, then rounding to the encoder's step."""

    noise_sd: Float[Array, " output"]
    resolution: Float[Array, " output"]

    @property
    def sd(self) -> Float[Array, " output"]:
        """Standard deviation of one measurement; rounding counts as uniform noise."""
        parts = self.noise_sd, self.resolution
        xp = jnp if any(isinstance(part, jax.core.Tracer) for part in parts) else np
        return floats(xp.sqrt(xp.square(parts[0]) + xp.square(parts[1]) / 12))


if TYPE_CHECKING:
    # For type checkers Equinox gives every class a dataclass constructor; all plants inherit
    # the one below.
    class _Module: ...
else:
    _Module = eqx.Module


class AbstractPlant(_Module):
    """Base of all plants: a class with a `definition`, a `derivative` and an `output`.

        >>> import excite as ex
        >>> class Tank(ex.AbstractPlant):
        ...     definition = ex.PlantDescription(
        ...         name="tank",
        ...         states=(ex.State("level", "m", initial=1.0),),
        ...         inputs=(ex.Input("inflow", "m³/s", 0.0, 0.02),),
        ...         outputs=(ex.Output("level", "m", scale=1.0, noise_sd=0.01),),
        ...         parameters=(ex.Parameter("area", "m²", 1.5),),
        ...         dt=1.0,
        ...         band=(0.001, 0.1),
        ...     )
        ...     def derivative(self, state, input, params):
        ...         return (input - 0.005 * state) / params.area
        ...     def output(self, state, params):
        ...         return state
        >>> ex.simulate(Tank, "prbs", steps=50).outputs.shape
        (51, 1)

    Attributes:
        definition: the class's description with its default numbers.
        constants: known constants, a named tuple in the order of the definition.
        sensor: noise and resolution of the outputs.
        initial_state: state at which an experiment starts.
        dt: sampling time [s].
        substeps: of the integration, in one `dt`.
    """

    definition: ClassVar[PlantDescription]
    constants: Any
    sensor: Sensor
    initial_state: Float[Array, " state"]
    dt: Float[Array, ""]
    substeps: int = eqx.field(static=True)

    def __init__(
        self,
        *,
        sensor: Sensor | None = None,
        initial_state: Float[Array, " state"] | None = None,
        dt: float | Float[Array, ""] | None = None,
        **constants: float | Float[Array, ""],
    ) -> None:
        """A plant with the numbers of its definition, except those given.

        Args:
            dt: sampling time [s]; it is integrated no more coarsely than in the definition.

        Raises:
            ValueError: for a constant that the definition does not have.
        """
        d = self.definition
        values: dict[str, Any] = {c.name: c.value for c in d.constants}
        if unknown := sorted(constants.keys() - values.keys()):
            raise ValueError(
                f"plant {d.name!r} has no constant {unknown[0]!r}; "
                f"it has {', '.join(values) or 'none'}"
            )
        values |= constants
        self.constants = _tuple_type("Constants", tuple(values))(*map(floats, values.values()))
        if not isinstance(sensor, Sensor | None):
            raise wrong_type("sensor", sensor, "an excite.plant.Sensor")
        self.sensor = sensor or Sensor(
            floats([o.noise_sd for o in d.outputs]), floats([o.resolution for o in d.outputs])
        )
        at_rest = [s.initial for s in d.states]
        self.initial_state = floats(at_rest if initial_state is None else initial_state)
        if self.initial_state.shape != (len(d.states),):
            allowed = f"{len(d.states)} numbers ({', '.join(names_of(d.states))})"
            raise wrong_type("initial_state", initial_state, allowed)
        self.dt = floats(d.dt if dt is None else dt)
        # Without a given dt a plant can be built from traced numbers.
        self.substeps = (
            d.substeps if dt is None else math.ceil(float(dt) * d.substeps / d.dt - 1e-3)
        )

    def __repr__(self) -> str:
        try:
            return repr(self.description)
        except TypeError:  # traced numbers cannot be shown
            return repr(self.definition)

    @abc.abstractmethod
    def derivative(
        self, state: Float[Array, " state"], input: Float[Array, " input"], params: Params
    ) -> Float[Array, " state"]:
        """Time derivative of the state, in state units per second."""

    @abc.abstractmethod
    def output(self, *arguments: Any, **named: Any) -> Float[Array, " output"]:
        """Noise-free outputs: a plant defines `output(self, state, params)`.

        Where an input acts on an output directly (feedthrough), it defines
        `output(self, state, input, params)`: sample k depends on the input of sample k, as in
        y_k = C x_k + D u_k.
        """

    def true_output(self, *arguments: Any) -> Float[Array, " output"]:
        """What is judged against the levels: the outputs without errors of their sensor.

        `output`, which identification predicts, has these errors, such as a bias. The arguments
        are the same.
        """
        return self.output(*arguments)

    def true_and_shown(
        self, *arguments: Any
    ) -> tuple[Float[Array, " output"], Float[Array, " output"]]:
        """`true_output` and `output`: computed once where they are the same."""
        shown = self.output(*arguments)
        is_same = type(self).true_output is AbstractPlant.true_output
        return (shown if is_same else self.true_output(*arguments)), shown

    @property
    def has_feedthrough(self) -> bool:
        """Whether `output` depends on the input directly."""
        return _takes_input(type(self))

    def feedthrough_input(
        self, input: Float[Array, " input"]
    ) -> tuple[Float[Array, " input"], ...]:
        """What `output` takes between state and params: the input, if there is feedthrough."""
        return (input,) if self.has_feedthrough else ()

    def delay(self, params: Params) -> Float[Array, " input"] | None:
        """Time after which each input acts [s]; None: all inputs act at once.

        It may be any number and depend on the parameters; a negative one says that the input is
        recorded late. Before its first sample an input has its first value.
        """
        return None

    @property
    def Params(self) -> Any:  # noqa: N802  (it is a class)
        """Named-tuple class of the parameters: `plant.Params(*vector)`."""
        return _tuple_type("Params", names_of(self.definition.parameters))

    @property
    def nominal(self) -> Params:
        """Nominal parameters."""
        return self.Params(*(floats(p.nominal) for p in self.definition.parameters))

    @property
    def description(self) -> PlantDescription:
        """The definition with this plant's numbers; not for use inside jit."""
        d, dt = self.definition, float(self.dt)
        return dataclasses.replace(
            d,
            constants=tuple(
                dataclasses.replace(c, value=float(v))
                for c, v in zip(d.constants, self.constants, strict=True)
            ),
            outputs=tuple(
                dataclasses.replace(o, noise_sd=float(sd), resolution=float(resolution))
                for o, sd, resolution in zip(
                    d.outputs,
                    *map(np.asarray, (self.sensor.noise_sd, self.sensor.resolution)),
                    strict=True,
                )
            ),
            states=tuple(
                dataclasses.replace(s, initial=float(x))
                for s, x in zip(d.states, np.asarray(self.initial_state), strict=True)
            ),
            dt=dt,
            band=(min(d.band[0], 0.25 / dt), min(d.band[1], 0.5 / dt)),
            substeps=self.substeps,
        )

    @property
    def process_noise_sd(self) -> Float[Array, " state"]:
        """Standard deviation of what disturbances add to the state in one `dt`."""
        declared = jnp.asarray([s.noise_sd for s in self.definition.states])
        return declared * jnp.sqrt(self.dt / self.definition.dt)

    @property
    def input_limits(self) -> tuple[Float[Array, " input"], Float[Array, " input"]]:
        """Lower and upper limit of the inputs."""
        inputs = self.definition.inputs
        return jnp.asarray([i.lower for i in inputs]), jnp.asarray([i.upper for i in inputs])

    def changed(self, **numbers: Any) -> Self:
        """The same plant with another `dt`, `sensor`, `initial_state` or constants.

        All but `dt` may be traced numbers.
        """
        return self.as_class(type(self), **numbers)

    def as_class(self, kind: type[_Plant], **numbers: Any) -> _Plant:
        """The plant in another class with these constants: its own numbers, but those given."""
        own = {"sensor": self.sensor, "initial_state": self.initial_state}
        plant = kind(**{**own, **self.constants._asdict(), **numbers})
        if "dt" not in numbers:
            plant = eqx.tree_at(lambda p: p.dt, plant, self.dt).integrated_in(self.substeps)
        return plant

    def integrated_in(self, substeps: int) -> Self:
        """The same plant with another number of Runge-Kutta steps in one `dt`."""
        plant = copy.copy(self)
        object.__setattr__(plant, "substeps", substeps)
        return plant


class AbstractARXPlant(AbstractPlant):
    """A plant of one input and one output whose parameters follow from an ARX model.

    The ARX model of order 2 is mapped to the differential equation
    y'' + c_1 y' + c_0 y = d_0 u by `excite.estimation.arx`; the plant does the rest.
    """

    @abc.abstractmethod
    def from_transfer_function(
        self, c_0: Float[Array, ""], c_1: Float[Array, ""], d_0: Float[Array, ""]
    ) -> Params:
        """Physical parameters of y'' + c_1 y' + c_0 y = d_0 u."""


def params_from(
    plant: AbstractPlant, values: Mapping[str, float] | Params | None = None, what: str = "params"
) -> Params:
    """Nominal parameters, except those given by name or as the plant's named tuple.

    Raises:
        ValueError: for an unknown name or a value outside the parameter's bounds.
        TypeError: for anything else.
    """
    given: Any = values
    if isinstance(values, tuple) and hasattr(values, "_asdict"):
        given = values._asdict()
    given = by_name(what, given, "a dict by name or the plant's named tuple")
    return plant.nominal._replace(
        **{name: floats(_allowed(plant, name, value)) for name, value in given.items()}
    )


def _allowed(plant: AbstractPlant, name: str, value: object) -> float:
    """The value of a parameter, within its bounds."""
    names = names_of(plant.definition.parameters)
    if name not in names:
        raise ValueError(
            f"plant {plant.definition.name!r} has no parameter {name!r}; it has {', '.join(names)}"
        )
    p, number = plant.definition.parameter(name), as_number(name, value)
    lower, upper = p.support
    if not lower < number < upper:
        above, below = f"{lower:g}", f"{upper:g}"
        raise ValueError(
            f"{name} = {number:g} {p.unit} is not allowed; it must be finite, above "
            f"{above.replace('-inf', 'minus infinity')} and below "
            f"{below.replace('inf', 'infinity')}"
        )
    return number


def with_nominal(plant: AbstractPlant, values: Mapping[str, float]) -> AbstractPlant:
    """The plant with other nominal parameters; their scales stay.

    A bound that a value touches is left out, because nominal values lie inside the bounds.

    Raises:
        ValueError: for an unknown name or a value that is not finite.
    """
    names = names_of(plant.definition.parameters)
    for name in values:
        if name not in names:
            raise unknown(f"parameter of {plant.definition.name!r}", name, names)
    usual = zip(names, plant.nominal, strict=True)
    nominal = tuple(as_number(name, values.get(name, value)) for name, value in usual)
    return plant.as_class(_tuned(type(plant), nominal))


_UNTUNED = "untuned"


def untuned(kind: type[AbstractPlant]) -> type[AbstractPlant]:
    """The class that `with_nominal` gave other nominal parameters; else the class itself."""
    return kind.__dict__.get(_UNTUNED, kind)


@cache
def _tuned(kind: type[AbstractPlant], nominal: tuple[float, ...]) -> type[AbstractPlant]:
    """The class with other nominal parameters; the same one every time, so that JAX knows it."""
    d = kind.definition

    def tuned(p: Parameter, value: float) -> Parameter:
        lower = p.lower if p.lower is not None and p.lower < value else None
        upper = p.upper if p.upper is not None and p.upper > value else None
        return dataclasses.replace(p, nominal=value, lower=lower, upper=upper)

    parameters = map(tuned, d.parameters, nominal)
    definition = dataclasses.replace(d, parameters=tuple(parameters))
    body = {"definition": definition, "__module__": kind.__module__, "__doc__": kind.__doc__}
    body[_UNTUNED] = untuned(kind)
    return type(kind.__name__, (kind,), body)


# Its numbers are leaves: another spread does not compile again.
jax.tree_util.register_dataclass(Spread, ["reach", "relative"], ["is_factor"])


@eqx.filter_jit
def draw_params(plant: AbstractPlant, key: PRNGKeyArray, spread: SpreadLike) -> Params:
    """Random parameters, each uniform within the `Spread` around its nominal value."""
    unit = jax.random.uniform(key, (len(plant.nominal),), float, -1.0, 1.0)
    return params_within(plant, spread, unit)


def params_within(plant: AbstractPlant, spread: SpreadLike, unit: Float[Array, " param"]) -> Params:
    """The parameters at coordinates in [-1, 1]."""
    reach, parameters = Spread.of(spread), plant.definition.parameters
    triples = zip(parameters, plant.nominal, unit, strict=True)
    return plant.Params(*(reach.value(p, nominal, u) for p, nominal, u in triples))
