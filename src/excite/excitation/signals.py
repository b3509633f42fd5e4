"""Open-loop signals: random, PRBS, chirp, multisine, square, decay, and replay."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..plant import AbstractPlant
from ..plant.fields import floats, optional_floats
from .contract import AbstractShape, AbstractSignal, Sequence

# Feedback taps of maximum-length shift registers (period 2^bits - 1), counted from 1;
# S. W. Golomb, Shift Register Sequences, 1967.
_TAPS = {
    2: (2, 1), 3: (3, 2), 4: (4, 3), 5: (5, 3), 6: (6, 5), 7: (7, 6), 8: (8, 6, 5, 4),
    9: (9, 5), 10: (10, 7), 11: (11, 9), 12: (12, 11, 10, 4), 13: (13, 12, 11, 8),
    14: (14, 13, 12, 2), 15: (15, 14), 16: (16, 15, 13, 4),
}  # fmt: skip


def _hold(values: Float[Array, "block input"], num_steps: int, samples: int) -> Sequence:
    return jnp.repeat(values, samples, axis=0)[:num_steps]


def _blocks(num_steps: int, samples: int, what: str) -> int:
    """Number of held values that fill `num_steps`."""
    if samples < 1:
        raise ValueError(f"{what} is a number of samples, at least 1: got {samples}")
    return -(-num_steps // samples)


class Random(AbstractShape):
    """Uniform random input, each value held for `hold` samples.

    Attributes:
        hold: samples for which a value is held.
    """

    hold: int = eqx.field(static=True, default=1)

    def shape(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """Independent values for every input."""
        shape = (_blocks(num_steps, self.hold, "hold"), len(plant.definition.inputs))
        unit = jax.random.uniform(key, shape, float, -1.0, 1.0)
        return _hold(unit, num_steps, self.hold)


class PRBS(AbstractShape):
    """Pseudo-random binary sequence: the input switches between two values.

    Attributes:
        clock: samples between two possible switches.
        register: bits of a maximum-length shift register (2 to 16), started at random;
            0 draws every value independently. A second input gets the sequence delayed by
            a fraction of its period (K. Godfrey, Perturbation Signals for System
            Identification, 1993).
    """

    clock: int = eqx.field(static=True, default=1)
    register: int = eqx.field(static=True, default=0)

    def shape(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """Two values for every input; the key draws them, or the start of the register."""
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
        return _hold(unit, num_steps, self.clock)


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
    """The frequency band of a signal [Hz], by default the plant's."""
    default = plant.definition.band
    nyquist = 0.5 / plant.dt
    low = jnp.minimum(default[0], 0.5 * nyquist) if low is None else low
    return low, jnp.minimum(default[1], nyquist) if high is None else high


class Chirp(AbstractShape):
    """Sine whose frequency sweeps the band once, linearly or logarithmically in time.

    A second input gets the sweep shifted cyclically by a fraction of the experiment.

    Attributes:
        start_frequency, stop_frequency: [Hz], default the plant's band.
        logarithmic: whether equal times are spent on equal frequency ratios.
    """

    start_frequency: Float[Array, ""] | None = eqx.field(converter=optional_floats, default=None)
    stop_frequency: Float[Array, ""] | None = eqx.field(converter=optional_floats, default=None)
    logarithmic: bool = eqx.field(static=True, default=False)

    def shape(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
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
        return jnp.stack([jnp.roll(sweep, shift) for shift in shifts], axis=1)


class Multisine(AbstractShape):
    """Sum of all harmonics of the experiment's length in a band.

    Schroeder's phases, -pi j (j - 1) / J for the j-th of J harmonics, keep the crest factor
    low (M. R. Schroeder, IEEE Trans. Information Theory 16, 1970). The sum is scaled to its
    peak. Several inputs get alternate harmonics, so that they are orthogonal.

    Attributes:
        start_frequency, stop_frequency: band [Hz], default the plant's.
        phases: 0 for Schroeder's; any other number is the seed of random ones.
    """

    start_frequency: Float[Array, ""] | None = eqx.field(converter=optional_floats, default=None)
    stop_frequency: Float[Array, ""] | None = eqx.field(converter=optional_floats, default=None)
    phases: int = eqx.field(static=True, default=0)

    def shape(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
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
        if self.phases:
            drawn = jax.random.uniform(jax.random.key(self.phases), phase.shape, float)
            phase = 2 * jnp.pi * drawn
        unit = jnp.fft.irfft(jnp.where(chosen, jnp.exp(1j * phase), 0.0), num_steps, axis=0)
        peak = jnp.max(jnp.abs(unit), axis=0, keepdims=True)
        return unit / jnp.where(peak > 0, peak, 1.0)


class Square(AbstractShape):
    """Square wave; the i-th input switches 2^i times as fast (i = 0, 1, ...).

    Attributes:
        frequency: of the first input [Hz], default the geometric mean of the plant's band.
    """

    frequency: Float[Array, ""] | None = eqx.field(converter=optional_floats, default=None)

    def shape(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """The same wave for every key, beginning with its upper value."""
        del key
        low, high = _band(plant, None, None)
        frequency = jnp.sqrt(low * high) if self.frequency is None else self.frequency
        octaves = 2.0 ** jnp.arange(len(plant.definition.inputs))
        half_periods = 2 * frequency * plant.dt * jnp.arange(num_steps)
        # The small number keeps a switch at its sample where rounding would delay it.
        count = jnp.floor(half_periods[:, None] * octaves[None] + 1e-9)
        return 1 - 2 * (count % 2)


class Decay(AbstractShape):
    """Pump and free decay: a square wave near resonance, then the input rests.

    The classical experiment for the damping of an oscillator, evaluated by the logarithmic
    decrement.

    Attributes:
        frequency: of the square wave [Hz], default the geometric mean of the plant's band.
        pump: fraction of the experiment for which the plant is driven.
    """

    frequency: Float[Array, ""] | None = eqx.field(converter=optional_floats, default=None)
    pump: Float[Array, ""] = eqx.field(converter=floats, default=0.3)

    def shape(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """The wave, then zero."""
        wave = Square(frequency=self.frequency).shape(plant, num_steps, key)
        return jnp.where(jnp.arange(num_steps)[:, None] < self.pump * num_steps, wave, 0.0)


class NoInput(AbstractSignal):
    """What excites a plant without inputs."""

    def sequence(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> Sequence:
        """Rows of no input."""
        del key
        return jnp.zeros((num_steps, len(plant.definition.inputs)))


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
