"""Excitations: they compute the next input from the measurements so far.

An excitation is `init` (before the experiment), `__call__` (at every sample) and, where an
input may be changed by a supervisor, `applied`. Signals ignore the measurement: `init`
computes their whole sequence. With several inputs, no input is a multiple of another,
because their effects could not be separated. On a rig,
`excite.rig.excitation.ExcitationPlayer` plays an excitation.

All values are bounded by the plant's input limits, and reproducible from a key.
"""

from __future__ import annotations

import abc
from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from ..plant import AbstractPlant
from ..plant.fields import optional_floats

Sequence: TypeAlias = Float[Array, "time input"]
SignalState: TypeAlias = tuple[Sequence, Int[Array, ""]]


class AbstractExcitation(eqx.Module):
    """Base of all excitations."""

    @property
    def uses_measurements(self) -> bool:
        """Whether an input depends on the measurements before it."""
        return True

    @abc.abstractmethod
    def init(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> PyTree:
        """State before the first sample of an experiment of `num_steps` steps."""

    @abc.abstractmethod
    def __call__(
        self, state: PyTree, measurement: Float[Array, " output"]
    ) -> tuple[PyTree, Float[Array, " input"]]:
        """Next state, and the input held until the next sample."""

    def applied(self, state: PyTree, input: Float[Array, " input"]) -> PyTree:
        """The state after an input was applied that may not be the proposed one."""
        del input
        return state


class AbstractSignal(AbstractExcitation):
    """An excitation that ignores the measurement: a sequence known beforehand."""

    @property
    def uses_measurements(self) -> bool:
        """False: a signal is known beforehand."""
        return False

    @abc.abstractmethod
    def sequence(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """All inputs of an experiment, in input units, within the input limits."""

    def init(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> SignalState:
        """The sequence and the index of its next row."""
        return self.sequence(plant, num_steps, key), jnp.asarray(0)

    def __call__(
        self, state: SignalState, measurement: Float[Array, " output"]
    ) -> tuple[SignalState, Float[Array, " input"]]:
        """The next row of the sequence."""
        del measurement
        sequence, k = state
        return (sequence, k + 1), sequence[k]


class AbstractShape(AbstractSignal):
    """A signal with a shape in [-1, 1], scaled by its amplitude around the middle of the limits.

    Attributes:
        amplitude: largest distance from that middle [input unit], one for all inputs or one
            for each; by default the plant's amplitude for classical signals.
    """

    amplitude: Float[Array, "..."] | None = eqx.field(converter=optional_floats, default=None)

    @abc.abstractmethod
    def shape(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """The whole sequence in [-1, 1]."""

    @eqx.filter_jit
    def sequence(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """The shape, scaled and clipped to the input limits."""
        lower, upper = plant.input_limits
        amplitude = self.amplitude
        if amplitude is None:
            amplitude = jnp.asarray([i.amplitude for i in plant.definition.inputs])
        amplitude = jnp.broadcast_to(amplitude, lower.shape)
        unit, middle = self.shape(plant, num_steps, key), (lower + upper) / 2
        return jnp.clip(middle[None] + amplitude[None] * unit, lower[None], upper[None])


def crest_factor(sequence: Sequence) -> Float[Array, " input"]:
    """Peak over root mean square of each input; infinite for an input that is zero."""
    peak = jnp.max(jnp.abs(sequence), axis=0)
    rms = jnp.sqrt(jnp.mean(sequence**2, axis=0))
    return jnp.where(rms > 0, peak / jnp.where(rms > 0, rms, 1.0), jnp.inf)
