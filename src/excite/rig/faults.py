"""Faults of a simulated rig's sensor and actuator, each from a time on.

What is wrong with a plant from the beginning needs no fault: gain, delay, lag, dead zone and
the like are effects that any plant can have (`plant.extension`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..plant.fields import floats

_NEVER = float("inf")
_CLOSE = 1e-9  # seconds: a reading that is due at a time is not before it


class Faults(eqx.Module):
    """Faults of a simulated rig; without arguments there are none. Times are in seconds.

    The faults of an actuator concern what acts on the plant, after latency and delay, and all
    inputs; those of a sensor concern readings, and all outputs.

    Attributes:
        sensor_frozen: from when on readings repeat the last one.
        sensor_slow: time constant of a first-order lag of the sensor, from the beginning.
        sensor_bias: is added to the readings of each output, in its unit.
        sensor_bias_from: from when on.
        actuator_stuck: from when on inputs act as they act then.
        actuator_dead: from when on nothing acts: the acting input is zero.
        actuator_sign: from when on inputs act with the opposite sign.
    """

    sensor_frozen: Float[Array, ""] = eqx.field(converter=floats, default=_NEVER)
    sensor_slow: Float[Array, ""] = eqx.field(converter=floats, default=0.0)
    sensor_bias: Float[Array, "..."] = eqx.field(converter=floats, default=0.0)
    sensor_bias_from: Float[Array, ""] = eqx.field(converter=floats, default=0.0)
    actuator_stuck: Float[Array, ""] = eqx.field(converter=floats, default=_NEVER)
    actuator_dead: Float[Array, ""] = eqx.field(converter=floats, default=_NEVER)
    actuator_sign: Float[Array, ""] = eqx.field(converter=floats, default=_NEVER)

    def acting(
        self, input: Float[Array, " input"], before: Float[Array, " input"], time: Float[Array, ""]
    ) -> Float[Array, " input"]:
        """What acts in place of an input.

        Args:
            before: what acted before.
            time: since the first reading [s].
        """
        input = jnp.where(time >= self.actuator_sign - _CLOSE, -input, input)
        input = jnp.where(time >= self.actuator_dead - _CLOSE, 0.0, input)
        return jnp.where(time >= self.actuator_stuck - _CLOSE, before, input)

    def followed(
        self,
        output: Float[Array, " output"],
        before: Float[Array, " output"],
        duration: Float[Array, ""],
    ) -> Float[Array, " output"]:
        """What a sensor shows of an output, without noise and bias; it showed `before`."""
        is_slow = self.sensor_slow > 0
        past = jnp.exp(-duration / jnp.where(is_slow, self.sensor_slow, 1.0))
        return jnp.where(is_slow, output + past * (before - output), output)

    def bias(self, time: Float[Array, ""]) -> Float[Array, "..."]:
        """Of the readings at a time."""
        return jnp.where(time >= self.sensor_bias_from - _CLOSE, self.sensor_bias, 0.0)

    def is_frozen(self, time: Float[Array, ""]) -> Array:
        """Whether the reading at a time repeats the one before it."""
        return time >= self.sensor_frozen - _CLOSE


NO_FAULTS = Faults()

_BIAS = "sensor_bias"


def fault_names(outputs: Sequence[str]) -> tuple[str, ...]:
    """Names of the faults for `faults_from`: a bias has the name of its output at the end."""
    names = [field.name for field in dataclasses.fields(Faults) if field.name != _BIAS]
    return (*names, *(f"{_BIAS}_{output}" for output in outputs))


def faults_from(outputs: Sequence[str], values: Mapping[str, float]) -> Faults:
    """Faults by name, as in `fault_names`.

    Raises:
        ValueError: for a time that is negative, or a bias that is not finite.
    """
    biases = [values.get(f"{_BIAS}_{output}", 0.0) for output in outputs]
    times = {n: values[n] for n in fault_names(()) if n in values}
    for name, value in times.items():
        if not value >= 0:
            raise ValueError(f"{name} must be 0 s or more: got {value:g}")
    for output, value in zip(outputs, biases, strict=True):
        if not math.isfinite(value):
            raise ValueError(f"{_BIAS}_{output} must be finite: got {value:g}")
    return Faults(**times, sensor_bias=biases)
