"""Excitations: what turns the measurements so far into the next input.

An excitation is `init` (before the experiment) and `__call__` (at every sample). Signals
ignore the measurement: they lay down their whole sequence in `init`. With several inputs
every input gets a sequence of its own that is not a multiple of another's, because inputs
that move together cannot be told apart.

All values are bounded by the plant's input limits, and reproducible from a key.
"""

from __future__ import annotations

import abc
import functools
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .plant import AbstractPlant
from .policy import (
    Layout,
    Policy,
    Window,
    empty_window,
    forward,
    observe,
    scaled_action,
    with_input,
    with_measurement,
)

Sequence: TypeAlias = Float[Array, "time input"]
SignalState: TypeAlias = Any

# Feedback taps of maximum-length shift registers (period 2^bits - 1), counted from 1;
# S. W. Golomb, Shift Register Sequences, 1967.
_TAPS = {
    2: (2, 1), 3: (3, 2), 4: (4, 3), 5: (5, 3), 6: (6, 5), 7: (7, 6), 8: (8, 6, 5, 4),
    9: (9, 5), 10: (10, 7), 11: (11, 9), 12: (12, 11, 10, 4), 13: (13, 12, 11, 8),
    14: (14, 13, 12, 2), 15: (15, 14), 16: (16, 15, 13, 4),
}  # fmt: skip


def optional_array(value: Any) -> Array | None:
    """An array of numbers, or None as it is; converts fields."""
    return None if value is None else jnp.asarray(value, float)


class AbstractExcitation(eqx.Module):
    """Base of all excitations."""

    @abc.abstractmethod
    def init(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Any:
        """State before the first sample of an experiment of `num_steps` steps."""

    @abc.abstractmethod
    def __call__(
        self, state: Any, measurement: Float[Array, " output"]
    ) -> tuple[Any, Float[Array, " input"]]:
        """Next state, and the input held until the next sample."""


class AbstractSignal(AbstractExcitation):
    """An excitation that ignores the measurement: a sequence known beforehand."""

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


def _scaled(unit: Sequence, plant: AbstractPlant, amplitude: Array | None) -> Sequence:
    """A sequence in [-1, 1] around the middle of the limits, clipped to them.

    Without an amplitude, that of the plant's description for classical signals.
    """
    lower, upper = plant.input_limits
    if amplitude is None:
        amplitude = jnp.asarray([i.amplitude for i in plant.definition.inputs])
    amplitude = jnp.broadcast_to(amplitude, lower.shape)
    middle = (lower + upper) / 2
    return jnp.clip(middle[None] + amplitude[None] * unit, lower[None], upper[None])


def _hold(values: Float[Array, "block input"], num_steps: int, samples: int) -> Sequence:
    return jnp.repeat(values, samples, axis=0)[:num_steps]


def _blocks(num_steps: int, samples: int, what: str) -> int:
    """Number of held values that fill `num_steps`."""
    if samples < 1:
        raise ValueError(f"{what} is a number of samples, at least 1: got {samples}")
    return -(-num_steps // samples)


class Random(AbstractSignal):
    """Uniform random input, each value held for `hold` samples.

    Attributes:
        amplitude: largest distance from the middle of the input limits [input unit].
        hold: samples for which a value is held.
    """

    amplitude: Float[Array, "..."] | None = eqx.field(converter=optional_array, default=None)
    hold: int = eqx.field(static=True, default=1)

    def sequence(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """Independent values for every input."""
        shape = (_blocks(num_steps, self.hold, "hold"), len(plant.definition.inputs))
        unit = jax.random.uniform(key, shape, float, -1.0, 1.0)
        return _scaled(_hold(unit, num_steps, self.hold), plant, self.amplitude)


class PRBS(AbstractSignal):
    """Pseudo-random binary sequence: the input switches between two values.

    Attributes:
        amplitude: distance of both values from the middle of the limits [input unit].
        clock: samples between two chances to switch.
        register: bits of a maximum-length shift register (2 to 16), started at random;
            0 draws every value independently. A second input gets the sequence delayed by
            a fraction of its period (K. Godfrey, Perturbation Signals for System
            Identification, 1993).
    """

    amplitude: Float[Array, "..."] | None = eqx.field(converter=optional_array, default=None)
    clock: int = eqx.field(static=True, default=1)
    register: int = eqx.field(static=True, default=0)

    def sequence(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """Two values for every input; the key draws them, or where the register starts."""
        blocks = _blocks(num_steps, self.clock, "clock")
        num_inputs = len(plant.definition.inputs)
        if self.register == 0:
            unit = jax.random.rademacher(key, (blocks, num_inputs), float)
        else:
            period = jnp.asarray(maximum_length_sequence(self.register))
            start = jax.random.randint(key, (), 0, period.size)
            delays = jnp.arange(num_inputs) * (period.size // num_inputs)
            index = start + jnp.arange(blocks)[:, None] - delays[None]
            unit = period[index % period.size]
        return _scaled(_hold(unit, num_steps, self.clock), plant, self.amplitude)


@functools.cache
def maximum_length_sequence(bits: int) -> Float[np.ndarray, " period"]:
    """One period of a maximum-length shift register, 2^bits - 1 values of -1 or 1.

    Raises:
        ValueError: for a number of bits whose taps are not known.
    """
    if bits not in _TAPS:
        raise ValueError(f"register has 2 to 16 bits, or 0 for none: got {bits}")
    register = [1] * bits
    values = np.empty(2**bits - 1)
    for k in range(values.size):
        values[k] = 2 * register[-1] - 1
        feedback = sum(register[tap - 1] for tap in _TAPS[bits]) % 2
        register = [feedback, *register[:-1]]
    return values


def _band(plant: AbstractPlant, low: Array | None, high: Array | None) -> tuple[Array, Array]:
    """The plant's frequency band [Hz] where a signal states none of its own."""
    default = plant.definition.band
    nyquist = 0.5 / plant.dt
    low = jnp.minimum(default[0], 0.5 * nyquist) if low is None else low
    return low, jnp.minimum(default[1], nyquist) if high is None else high


class Chirp(AbstractSignal):
    """Sine whose frequency sweeps the band once, linearly or logarithmically in time.

    A second input gets the sweep shifted cyclically by a fraction of the experiment.

    Attributes:
        amplitude: of the sine [input unit].
        start_frequency, stop_frequency: [Hz], default the plant's band.
        logarithmic: whether equal times are spent on equal frequency ratios.
    """

    amplitude: Float[Array, "..."] | None = eqx.field(converter=optional_array, default=None)
    start_frequency: Float[Array, ""] | None = eqx.field(converter=optional_array, default=None)
    stop_frequency: Float[Array, ""] | None = eqx.field(converter=optional_array, default=None)
    logarithmic: bool = eqx.field(static=True, default=False)

    def sequence(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """The same sweep for every key."""
        del key
        low, high = _band(plant, self.start_frequency, self.stop_frequency)
        duration = num_steps * plant.dt
        time = jnp.arange(num_steps) * plant.dt
        if self.logarithmic:
            rate = jnp.log(high / low) / duration
            growth = jnp.expm1(rate * time) / jnp.where(rate == 0, 1.0, rate)
            cycles = low * jnp.where(rate == 0, time, growth)
        else:
            cycles = low * time + (high - low) * time**2 / (2 * duration)
        num_inputs = len(plant.definition.inputs)
        shifts = [i * num_steps // num_inputs for i in range(num_inputs)]
        sweep = jnp.sin(2 * jnp.pi * cycles)
        unit = jnp.stack([jnp.roll(sweep, shift) for shift in shifts], axis=1)
        return _scaled(unit, plant, self.amplitude)


class Multisine(AbstractSignal):
    """Sum of all harmonics of the experiment's length in a band, with Schroeder phases.

    Its phases, -pi j (j - 1) / J for the j-th of J harmonics, keep the crest factor low
    (M. R. Schroeder, IEEE Trans. Information Theory 16, 1970). The sum is scaled to its
    peak. Several inputs take turns with the harmonics, so that they are orthogonal.

    Attributes:
        amplitude: largest magnitude of the sum [input unit].
        start_frequency, stop_frequency: band [Hz], default the plant's.
    """

    amplitude: Float[Array, "..."] | None = eqx.field(converter=optional_array, default=None)
    start_frequency: Float[Array, ""] | None = eqx.field(converter=optional_array, default=None)
    stop_frequency: Float[Array, ""] | None = eqx.field(converter=optional_array, default=None)

    def sequence(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """The same sum for every key; zero where the band holds no harmonic."""
        del key
        low, high = _band(plant, self.start_frequency, self.stop_frequency)
        num_inputs = len(plant.definition.inputs)
        harmonic = jnp.arange(num_steps // 2 + 1)
        frequency = harmonic / (num_steps * plant.dt)
        in_band = (harmonic > 0) & (frequency >= low - 1e-9) & (frequency <= high + 1e-9)
        turn = (jnp.cumsum(in_band) - 1) % num_inputs
        chosen = in_band[:, None] & (turn[:, None] == jnp.arange(num_inputs)[None])
        j = jnp.cumsum(chosen, axis=0)
        phase = -jnp.pi * j * (j - 1) / jnp.maximum(j[-1:], 1)
        unit = jnp.fft.irfft(jnp.where(chosen, jnp.exp(1j * phase), 0.0), num_steps, axis=0)
        peak = jnp.max(jnp.abs(unit), axis=0, keepdims=True)
        return _scaled(unit / jnp.where(peak > 0, peak, 1.0), plant, self.amplitude)


class Square(AbstractSignal):
    """Square wave; the i-th input switches 2^i times as fast (i = 0, 1, ...).

    Attributes:
        amplitude: distance of both values from the middle of the limits [input unit].
        frequency: of the first input [Hz], default the geometric mean of the plant's band.
    """

    amplitude: Float[Array, "..."] | None = eqx.field(converter=optional_array, default=None)
    frequency: Float[Array, ""] | None = eqx.field(converter=optional_array, default=None)

    def sequence(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """The same wave for every key, beginning with its upper value."""
        del key
        low, high = _band(plant, None, None)
        frequency = jnp.sqrt(low * high) if self.frequency is None else self.frequency
        octaves = 2.0 ** jnp.arange(len(plant.definition.inputs))
        half_periods = 2 * frequency * plant.dt * jnp.arange(num_steps)
        # The small number keeps a switch at its sample where rounding would delay it.
        count = jnp.floor(half_periods[:, None] * octaves[None] + 1e-9)
        return _scaled(1 - 2 * (count % 2), plant, self.amplitude)


class Replay(AbstractSignal):
    """A recorded or designed input, clipped to the plant's limits.

    Attributes:
        inputs: one row a sample [input units].
    """

    inputs: Sequence

    def sequence(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """The first `num_steps` rows.

        Raises:
            ValueError: where the recording is shorter, or has another number of inputs.
        """
        del key
        rows, width = self.inputs.shape
        if rows < num_steps or width != len(plant.definition.inputs):
            raise ValueError(
                f"the recorded input has {rows} samples of {width} inputs; the experiment "
                f"needs {num_steps} samples of {len(plant.definition.inputs)}"
            )
        lower, upper = plant.input_limits
        return jnp.clip(self.inputs[:num_steps], lower[None], upper[None])


class PolicyExcitation(AbstractExcitation):
    """A learned policy: the only excitation here that looks at the measurements.

    Attributes:
        weights: of the network, single precision.
        layout: what it observes.
    """

    weights: tuple[tuple[Float[Array, "_to _from"], Float[Array, " _to"]], ...]
    layout: Layout = eqx.field(static=True)

    @classmethod
    def of(cls, policy: Policy) -> PolicyExcitation:
        """The excitation of a policy read from a file."""
        layers = tuple((jnp.asarray(m), jnp.asarray(b)) for m, b in policy.weights)
        return cls(layers, policy.layout)

    def init(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> tuple[Window, Array]:
        """An empty window and k = 0.

        Raises:
            ValueError: for an experiment longer than the policy was made for.
        """
        del plant, key
        if num_steps > self.layout.num_steps:
            raise ValueError(
                f"the policy was made for {self.layout.num_steps} steps; "
                f"the experiment has {num_steps}"
            )
        return empty_window(jnp, self.layout), jnp.asarray(0)

    def __call__(
        self, state: tuple[Window, Array], measurement: Float[Array, " output"]
    ) -> tuple[tuple[Window, Array], Float[Array, " input"]]:
        """The network's input for the window that ends with this measurement."""
        window, k = state
        window = with_measurement(jnp, self.layout, window, measurement)
        action = forward(jnp, self.weights, observe(jnp, self.layout, window, k))
        input = scaled_action(jnp, self.layout, action.astype(float))
        return (with_input(jnp, self.layout, window, input), k + 1), input


def crest_factor(sequence: Sequence) -> Float[Array, " input"]:
    """Peak over root mean square of each input; infinite for an input that is zero."""
    peak = jnp.max(jnp.abs(sequence), axis=0)
    rms = jnp.sqrt(jnp.mean(sequence**2, axis=0))
    return jnp.where(rms > 0, peak / jnp.where(rms > 0, rms, 1.0), jnp.inf)
