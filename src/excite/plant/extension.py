"""Extensions: effects that the equations of a plant leave out, each with one parameter.

    delay_voltage, lag_voltage      the input acts later (negative: it is recorded late), or
                                    through a first-order lag [s]
    gain_voltage                    factor of the input, -1 for a wrong sign
    offset_voltage                  is added to the input
    saturation_voltage              largest magnitude of the input
    dead_zone_voltage               magnitude up to which the input does nothing
    coulomb_speed, drag_speed       deceleration c sign(v) or c v |v| of a velocity v
    bias_pitch, drift_pitch         is added to the output, the second times the time, by its
                                    sensor: levels are judged without it

They act in this order. A plant with extensions is a plant like any other, named
`aero2+delay_voltage`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..description import Parameter, PlantDescription, State, names_of, unknown
from .contract import AbstractPlant, Params, with_nominal
from .fields import floats
from .static import require_sensor_noise

_INPUT, _VELOCITY, _OUTPUT = (
    ("delay", "lag", "gain", "offset", "saturation", "dead_zone"),
    ("coulomb", "drag"),
    ("bias", "drift"),
)
HOLDS = "constant", "linear"
"""What an input does between samples; it is no extension, but explains a residual like one."""
_VELOCITIES = "m/s", "rad/s"
_SHARP = 0.02  # scales of a velocity in which Coulomb friction changes its sign
_SHORTEST = 0.4  # Runge-Kutta steps; a shorter lag would be integrated without stability


@dataclasses.dataclass(frozen=True)
class _Extension:
    kind: str
    channel: str
    index: int  # of the channel

    @property
    def name(self) -> str:
        return f"{self.kind}_{self.channel}"


def _extensions(kind: type[AbstractPlant]) -> tuple[_Extension, ...]:
    """All that a plant can have, in their order; with feedthrough, inputs cannot be delayed."""
    d, has_feedthrough = kind.definition, kind().has_feedthrough
    velocities = [(i, s.name) for i, s in enumerate(d.states) if s.unit in _VELOCITIES]
    channels = (
        (_INPUT, list(enumerate(names_of(d.inputs)))),
        (_VELOCITY, velocities),
        (_OUTPUT, list(enumerate(names_of(d.outputs)))),
    )
    return tuple(
        _Extension(effect, channel, index)
        for effects, of_kind in channels
        for effect in effects
        for index, channel in of_kind
        if not (has_feedthrough and effect == "delay")
    )


def extensions_of(plant: AbstractPlant) -> tuple[str, ...]:
    """Names of the extensions that a plant can have, and does not have yet."""
    kind, own = plain_kind(plant), names_of(plant.definition.parameters)
    return tuple(e.name for e in _extensions(kind) if e.name not in own)


def plain_kind(plant: AbstractPlant) -> type[AbstractPlant]:
    """The class of a plant without its extensions."""
    return plant.plain if isinstance(plant, Extended) else type(plant)


def extended(plant: AbstractPlant, extensions: Sequence[str]) -> AbstractPlant:
    """The plant with extensions, each an unknown parameter of the same name.

    Args:
        extensions: names such as `delay_voltage`, or `delay` where there is one input.

    Raises:
        ValueError: for an unknown name, or one that the plant has.
    """
    kind = plain_kind(plant)
    if extensions:
        require_sensor_noise(plant)
    possible, chosen = _extensions(kind), {*names_of(plant.definition.parameters)}
    for word in extensions:
        found = [e.name for e in possible if word in (e.kind, e.name)]
        if len(found) != 1:
            if plant.has_feedthrough and word.startswith("delay"):
                raise ValueError(delayed_feedthrough(kind.definition.name))
            if option := _option_for(kind.definition, word):
                raise ValueError(
                    f"{word!r} is no extension of plant {kind.definition.name!r}, but the option "
                    f"{option}"
                )
            kinds = [e.kind for e in possible]
            short = [e.kind if kinds.count(e.kind) == 1 else e.name for e in possible]
            raise unknown(f"extension of plant {kind.definition.name!r}:", word, found or short)
        if found[0] in chosen:
            raise ValueError(f"plant {plant.definition.name!r} has {found[0]!r} already")
        chosen |= {found[0]}
    whole = _class_of(kind, tuple(e for e in possible if e.name in chosen))
    start, states = np.array(whole().initial_state), names_of(whole.definition.states)
    for name, value in zip(names_of(plant.definition.states), plant.initial_state, strict=True):
        start[states.index(name)] = value
    made = plant.as_class(whole, initial_state=floats(start))
    own = {p.name: p.nominal for p in plant.definition.parameters}
    is_changed = any(made.definition.parameter(name).nominal != own[name] for name in own)
    return with_nominal(made, own) if is_changed else made


def delayed_feedthrough(name: str) -> str:
    """Why a plant with feedthrough has no delay."""
    return (
        f"an input of plant {name!r} acts on an output directly, and cannot be delayed, too: shift "
        "the rows of the input in the file instead"
    )


def _option_for(d: PlantDescription, word: str) -> str | None:
    """The option of `identify` for an effect that it names and that is no extension."""
    hold, _, channel = word.partition("_")
    if hold in HOLDS and channel in names_of(d.inputs):
        return f"--hold-input {channel}={hold}"
    return "--likelihood student" if word == "outliers" else None


class Extended(AbstractPlant):
    """A plant with extensions; its parameters and states come after those of the plain plant."""

    plain: ClassVar[type[AbstractPlant]]
    extensions: ClassVar[tuple[_Extension, ...]]

    def derivative(
        self, state: Float[Array, " state"], input: Float[Array, " input"], params: Params
    ) -> Float[Array, " state"]:
        """Of the plain plant's states, then of those of lags and drifts."""
        own_states = len(self.plain.definition.states)
        acting, slopes = self._acting(state, input, params)
        friction = [jnp.asarray(0.0)] * own_states
        for e in self.extensions:
            value, at = getattr(params, e.name), e.index
            if e.kind == "coulomb":
                smooth = _SHARP * self.definition.states[at].scale
                friction[at] += value * jnp.tanh(state[at] / smooth)
            elif e.kind == "drag":
                friction[at] += value * state[at] * jnp.abs(state[at])
            elif e.kind == "drift":
                slopes.append(value)
        slope = self._plain().derivative(state[:own_states], acting, self._own(params))
        slope = slope - jnp.stack(friction)
        return jnp.concatenate([slope, jnp.stack(slopes)]) if slopes else slope

    def _acting(
        self, state: Float[Array, " state"], input: Float[Array, " input"], params: Params
    ) -> tuple[Float[Array, " input"], list[Float[Array, ""]]]:
        """The inputs as they act on the plain plant, and the slopes of the states of lags."""
        inputs, slopes = list(input), []
        added = list(state[len(self.plain.definition.states) :])
        for e in self.extensions:
            value, at = getattr(params, e.name), e.index
            if e.kind == "lag":
                lagging = added.pop(0)
                slopes.append((inputs[at] - lagging) / jnp.maximum(value, self._shortest_lag))
                inputs[at] = jnp.where(value > 0, lagging, inputs[at])
            elif e.kind == "gain":
                inputs[at] *= value
            elif e.kind == "offset":
                inputs[at] += value
            elif e.kind == "saturation":
                inputs[at] = jnp.clip(inputs[at], -value, value)
            elif e.kind == "dead_zone":
                inputs[at] -= jnp.clip(inputs[at], -value, value)
        return (jnp.stack(inputs) if inputs else input), slopes

    @property
    def has_feedthrough(self) -> bool:
        """As the plain plant."""
        return self._plain().has_feedthrough

    def output(self, *arguments: Any) -> Float[Array, " output"]:
        """Of the plain plant, with biases and drifts."""
        state, *_, params = arguments
        num_own = len(self.plain.definition.states)
        outputs = list(self._plain().output(*self._of_plain(*arguments)))
        drifts = list(state[num_own + sum(e.kind == "lag" for e in self.extensions) :])
        for e in self.extensions:
            value = getattr(params, e.name)
            if e.kind == "bias":
                outputs[e.index] += value
            elif e.kind == "drift":
                outputs[e.index] += jnp.where(value != 0, drifts.pop(0), 0.0)
        return jnp.stack(outputs)

    def true_output(self, *arguments: Any) -> Float[Array, " output"]:
        """Of the plain plant: biases and drifts are of its sensors."""
        return self._plain().true_output(*self._of_plain(*arguments))

    def _of_plain(self, *arguments: Any) -> tuple[Any, ...]:
        """Arguments of the plain plant's `output`."""
        state, *input, params = arguments
        own = (self._acting(state, given, params)[0] for given in input)
        return state[: len(self.plain.definition.states)], *own, self._own(params)

    def delay(self, params: Params) -> Float[Array, " input"] | None:
        """Of the plain plant, and the added ones."""
        delay = self._plain().delay(self._own(params))
        added = {e.index: getattr(params, e.name) for e in self.extensions if e.kind == "delay"}
        if not added:
            return delay
        own = jnp.zeros(len(self.definition.inputs)) if delay is None else delay
        return jnp.stack([own[i] + added.get(i, 0.0) for i in range(len(own))])

    def _plain(self) -> AbstractPlant:
        return self.plain(**self.constants._asdict())

    def _own(self, params: Params) -> Params:
        """Parameters of the plain plant."""
        own = len(self.plain.definition.parameters)
        return _params_type(self.plain)(*params[:own])

    @property
    def _shortest_lag(self) -> Array:
        return _SHORTEST * self.dt / self.substeps


@cache
def _params_type(kind: type[AbstractPlant]) -> type:
    return kind().Params


@cache
def _class_of(kind: type[AbstractPlant], extensions: tuple[_Extension, ...]) -> type[Extended]:
    """The class of a plant with extensions; the same one every time, so that JAX knows it."""
    d, plant = kind.definition, kind()
    definition = dataclasses.replace(
        d,
        name="+".join([d.name, *(e.name for e in extensions)]),
        states=(*d.states, *(s for e in extensions for s in _states(d, e))),
        parameters=(*d.parameters, *(_parameter(plant, e) for e in extensions)),
    )
    body = {"definition": definition, "plain": kind, "extensions": extensions}
    body |= {"__module__": __name__, "__doc__": kind.__doc__}
    return type(f"{kind.__name__}Extended", (Extended,), body)


def _states(d: PlantDescription, e: _Extension) -> tuple[State, ...]:
    """The state that an extension adds."""
    if e.kind == "lag":
        u = d.inputs[e.index]
        return (State(e.name, u.unit, initial=min(max(0.0, u.lower), u.upper), scale=u.amplitude),)
    if e.kind == "drift":
        return (State(e.name, d.outputs[e.index].unit, scale=d.outputs[e.index].scale),)
    return ()


def _parameter(plant: AbstractPlant, e: _Extension) -> Parameter:
    """The parameter of an extension; it starts small, in proportion to the plant's own sizes."""
    d = plant.definition

    def size(unit: str, nominal: float, scale: float, lower: float | None = 0.0) -> Parameter:
        return Parameter(
            e.name, unit, nominal, scale=scale, lower=lower, positive=False, target=False
        )

    if e.kind == "delay":
        return size("s", d.dt / 2, d.dt, None)
    if e.kind == "lag":
        return size("s", d.dt / 2, d.dt)
    if e.kind in _INPUT:
        u = d.inputs[e.index]
        if e.kind == "saturation":
            return Parameter(e.name, u.unit, u.amplitude, target=False)
        if e.kind == "gain":
            return size("", 1.0, 1.0, None)
        if e.kind == "dead_zone":
            return size(u.unit, 0.05 * u.amplitude, 0.1 * u.amplitude)
        return size(u.unit, 0.0, 0.1 * u.amplitude, None)
    if e.kind in _VELOCITY:
        v = d.states[e.index]
        usual = _deceleration(plant, e.index)
        if e.kind == "coulomb":
            return size(f"{v.unit}²", 0.05 * usual, usual)
        return size(f"1/{v.unit[:-2]}", 0.05 * usual / v.scale**2, usual / v.scale**2)
    y = d.outputs[e.index]
    if e.kind == "bias":
        return size(y.unit, 0.0, 0.1 * y.scale, None)
    return size(f"{y.unit}/s", 0.001 * y.scale, 0.01 * y.scale, None)


def _deceleration(plant: AbstractPlant, index: int) -> float:
    """A usual change of a velocity per second."""
    d = plant.definition
    state = jnp.asarray([s.initial + s.scale for s in d.states])
    inputs = jnp.asarray([i.amplitude for i in d.inputs])
    slope = float(np.abs(plant.derivative(state, inputs, plant.nominal)[index]))
    return slope if np.isfinite(slope) and slope > 0 else d.states[index].scale
