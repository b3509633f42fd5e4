"""From inputs to outputs: `response` without noise, `run_episode` in closed loop.

Sample k is measured at time k dt; the input chosen then is held until k + 1. An
experiment of T steps therefore has T inputs and T + 1 measurements. Integration is the
classical Runge-Kutta method of order 4 with a fixed number of substeps, so that the
response is one differentiable function of everything that enters it.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .excitation import AbstractExcitation
from .plant import AbstractPlant, Params


class Trajectory(eqx.Module):
    """One experiment; time is axis 0.

    Attributes:
        time: sampling instants [s].
        inputs: row k is held from time[k] to time[k + 1].
        measured: outputs as the sensor saw them.
        outputs: true outputs.
    """

    time: Float[Array, " sample"]
    inputs: Float[Array, "time input"]
    measured: Float[Array, "sample output"]
    outputs: Float[Array, "sample output"]


def step(
    plant: AbstractPlant,
    state: Float[Array, " state"],
    input: Float[Array, " input"],
    params: Params,
) -> Float[Array, " state"]:
    """State one sampling time later, the input held."""
    h = plant.dt / plant.substeps

    def substep(x: Array, _: None) -> tuple[Array, None]:
        k1 = plant.derivative(x, input, params)
        k2 = plant.derivative(x + h / 2 * k1, input, params)
        k3 = plant.derivative(x + h / 2 * k2, input, params)
        k4 = plant.derivative(x + h * k3, input, params)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), None

    # A few substeps are unrolled: the inner loop's own cost would exceed theirs.
    unroll = min(plant.substeps, 4)
    return jax.lax.scan(substep, state, None, length=plant.substeps, unroll=unroll)[0]


@eqx.filter_jit
def response(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "time input"],
    initial_state: Float[Array, " state"] | None = None,
) -> Float[Array, "time+1 output"]:
    """Noise-free outputs at all samples, from the plant's initial state unless given."""
    start = plant.initial_state if initial_state is None else initial_state

    def advance(state: Array, input: Array) -> tuple[Array, Array]:
        state = step(plant, state, input, params)
        return state, plant.output(state, params)

    _, outputs = jax.lax.scan(advance, start, inputs)
    return jnp.concatenate([plant.output(start, params)[None], outputs])


def measure(
    plant: AbstractPlant, output: Float[Array, " output"], key: PRNGKeyArray
) -> Float[Array, " output"]:
    """What the sensor shows: noise is added, then an encoder rounds to its step."""
    sensor = plant.sensor
    noisy = output + sensor.noise_sd * jax.random.normal(key, output.shape, float)
    resolution = jnp.where(sensor.resolution > 0, sensor.resolution, 1.0)
    rounded = jnp.where(sensor.resolution > 0, jnp.round(noisy / resolution) * resolution, noisy)
    # Straight-through: rounding has no useful derivative, the measurement has.
    return noisy + jax.lax.stop_gradient(rounded - noisy)


@eqx.filter_jit
def run_episode(
    plant: AbstractPlant,
    params: Params,
    excitation: AbstractExcitation,
    num_steps: int,
    key: PRNGKeyArray,
) -> Trajectory:
    """One experiment in closed loop: measure, excite, clip to the limits, integrate.

    The sensor's noise depends on the key alone, so that with one key every excitation
    meets the same noise.
    """
    excitation_key, sensor_key = jax.random.split(key)
    noise_keys = jax.random.split(sensor_key, num_steps + 1)
    lower, upper = plant.input_limits

    def advance(carry: tuple, noise_key: PRNGKeyArray) -> tuple[tuple, tuple]:
        state, memory = carry
        output = plant.output(state, params)
        measured = measure(plant, output, noise_key)
        memory, input = excitation(memory, measured)
        input = jnp.clip(input, lower, upper)
        return (step(plant, state, input, params), memory), (input, measured, output)

    start = plant.initial_state, excitation.init(plant, num_steps, excitation_key)
    (state, _), (inputs, measured, outputs) = jax.lax.scan(advance, start, noise_keys[:-1])
    last = plant.output(state, params)
    return Trajectory(
        time=jnp.arange(num_steps + 1) * plant.dt,
        inputs=inputs,
        measured=jnp.concatenate([measured, measure(plant, last, noise_keys[-1])[None]]),
        outputs=jnp.concatenate([outputs, last[None]]),
    )
