"""From inputs to outputs: `response` without noise, `run_episode` in closed loop, `simulate`.

Sample k is measured at time k dt; the input chosen then is held until k + 1. An
experiment of T steps therefore has T inputs and T + 1 measurements. Integration is the
classical Runge-Kutta method of order 4 with a fixed number of substeps, so that the
response is one differentiable function of everything that enters it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from . import __version__
from .description import by_name, names_of, require_whole, wrong_type
from .excitation import AbstractExcitation, Coast, NoInput, PolicyExcitation, Replay
from .excitation.catalogue import ExcitationLike, excitation_and_origin, name_of, usual_signal
from .files import json_ready
from .plant import AbstractPlant, Params, params_from
from .plant.catalogue import PlantLike, plant_from, with_sensor
from .plant.static import AbstractStaticTask, has_own_noise, require_sensor_noise
from .record import Record

_State = TypeVar("_State")


class Trajectory(eqx.Module):
    """One experiment; time is axis 0.

    Attributes:
        time: sampling instants [s].
        inputs: row k is held from time[k] to time[k + 1].
        measured: outputs of the sensor.
        outputs: true ones, without noise and other errors of the sensor.
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
    dt: Float[Array, ""] | None = None,
    next_input: Float[Array, " input"] | None = None,
) -> Float[Array, " state"]:
    """State one sample later.

    Args:
        dt: time between the samples [s]; default the plant's.
        next_input: at the next sample, if the input is linear between them; default it is held.
    """
    if isinstance(plant, AbstractStaticTask):
        return plant.after(input)
    n = plant.substeps
    h = (plant.dt if dt is None else dt) / n

    def at(fraction: Array | float) -> Array:
        return input if next_input is None else input + fraction * (next_input - input)

    def euler(x: Array, k: Array) -> tuple[Array, None]:
        return x + h * plant.derivative(x, at(k / n), params), None

    def runge_kutta(x: Array, k: Array) -> tuple[Array, None]:
        first, middle, last = at(k / n), at((k + 0.5) / n), at((k + 1) / n)
        k1 = plant.derivative(x, first, params)
        k2 = plant.derivative(x + h / 2 * k1, middle, params)
        k3 = plant.derivative(x + h / 2 * k2, middle, params)
        k4 = plant.derivative(x + h * k3, last, params)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), None

    is_euler = plant.definition.integrator == "euler"
    return over_substeps(euler if is_euler else runge_kutta, state, n)


def disturbed(
    plant: AbstractPlant, state: Float[Array, " state"], key: PRNGKeyArray
) -> Float[Array, " state"]:
    """The state after the process noise of one sampling time."""
    if not plant.definition.is_disturbed:
        return state
    return state + plant.process_noise_sd * jax.random.normal(key, state.shape, float)


def over_substeps(
    substep: Callable[[_State, Array], tuple[_State, None]], start: _State, n: int
) -> _State:
    """What `n` substeps make of a state; a substep gets the state and its index.

    Two are unrolled, because a loop would cost more. More copies take too long to compile.
    """
    return jax.lax.scan(substep, start, jnp.arange(n), unroll=n if n < 3 else 1)[0]


def delayed(
    inputs: Float[Array, "time input"],
    delay: Float[Array, " input"],
    dt: Float[Array, " time"],
    next_inputs: Float[Array, "time input"] | None = None,
) -> tuple[Float[Array, "time input"], Float[Array, "time input"]]:
    """Inputs after a delay, at the beginning and the end of each step, and linear in between.

    In each step they have the mean and the first moment of the delayed input: a double
    integrator is at its exact state at every sample. They are continuous in the delay.

    Args:
        delay: of each input [s]; negative for one that acts earlier.
        dt: time from each sample to the next [s].
        next_inputs: see `response`.
    """
    times = jnp.concatenate([jnp.zeros(1), jnp.cumsum(dt)])

    def after(u: Array, u_next: Array, delay: Array) -> tuple[Array, Array]:
        centre = jnp.mean(u)  # its integrals stay small, and keep their digits
        u, u_next = u - centre, u_next - centre
        slope = jnp.append((u_next - u) / jnp.where(dt > 0, dt, 1.0), 0.0)
        first = _summed(dt * (u + u_next) / 2)
        second = _summed(dt * first[:-1] + dt**2 * (u / 3 + u_next / 6))

        acting = jnp.append(u, u_next[-1])

        def integrals(t: Array) -> tuple[Array, Array]:
            """The input integrated once and twice; it is constant before and after the record."""
            k = jnp.clip(jnp.searchsorted(times, t) - 1, 0, len(u))
            past = t - times[k]
            a, b, c, s = second[k], first[k], acting[k], jnp.where(past > 0, slope[k], 0.0)
            return b + past * (c + past * s / 2), a + past * (b + past * (c / 2 + past * s / 6))

        once, twice = integrals(times - delay)
        steps = jnp.where(dt > 0, dt, 1.0)
        mean = jnp.diff(once) / steps
        moment = (once[:-1] + once[1:]) / 2 - jnp.diff(twice) / steps
        return centre + mean - 6 * moment / steps, centre + mean + 6 * moment / steps

    return jax.vmap(after, in_axes=(1, 1, 0), out_axes=1)(
        inputs, inputs if next_inputs is None else next_inputs, delay
    )


def acting(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "time input"],
    dt: Float[Array, " time"] | None,
    next_inputs: Float[Array, "time input"] | None,
) -> tuple[Float[Array, "time input"], Float[Array, " time"] | None, Array | None]:
    """Inputs, dt and next inputs as they act on the plant: after its delay, if it has one."""
    if (delay := plant.delay(params)) is not None:
        dt = jnp.full(len(inputs), plant.dt) if dt is None else dt
        inputs, next_inputs = delayed(inputs, delay, dt, next_inputs)
    return inputs, dt, next_inputs


def _summed(values: Array) -> Array:
    """Cumulative sums, beginning with zero."""
    return jnp.concatenate([jnp.zeros(1), jnp.cumsum(values)])


@eqx.filter_jit
def response(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "time input"],
    initial_state: Float[Array, " state"] | None = None,
    dt: Float[Array, " time"] | None = None,
    next_inputs: Float[Array, "time input"] | None = None,
) -> Float[Array, "time+1 output"]:
    """Noise-free outputs at all samples, from the plant's initial state unless given.

    Args:
        dt: time from each sample to the next [s]; default the plant's sampling time.
        next_inputs: see `step`; of the last step, what acts on the last sample directly.
    """
    start = plant.initial_state if initial_state is None else initial_state
    steps = acting(plant, params, inputs, dt, next_inputs)

    def advance(state: Array, now: tuple) -> tuple[Array, Array]:
        (input, dt, next_input), following = now
        state = step(plant, state, input, params, dt, next_input)
        return state, plant.output(state, *following, params)

    if isinstance(plant, AbstractStaticTask):  # all designs at once: none waits for another
        outputs = jax.vmap(lambda design: plant.output(plant.after(design), params))(inputs)
        return jnp.concatenate([plant.output(start, params)[None], outputs])
    begin, following = (), ()
    if plant.has_feedthrough:
        last = inputs[-1:] if next_inputs is None else next_inputs[-1:]
        begin, following = (inputs[0],), (jnp.concatenate([inputs[1:], last]),)
    _, outputs = jax.lax.scan(advance, start, (steps, following))
    return jnp.concatenate([plant.output(start, *begin, params)[None], outputs])


@eqx.filter_jit
def predicted(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "time input"],
    measured: Float[Array, "time+1 output"],
) -> tuple[Float[Array, "time+1 output"], Float[Array, " output"]]:
    """What the model expects of the measurements, and their standard deviations about it.

    Where the state is observed, each sample is predicted from the one before, and differs from
    that by process noise: the likelihood of a record is that of its transitions. Otherwise it is
    the response, from which a measurement differs by the noise of its sensor.

    Raises:
        ValueError: for process noise and a state that is not observed.
    """
    if not require_likelihood(plant):
        return response(plant, params, inputs), plant.sensor.sd
    steps = acting(plant, params, inputs, None, None)
    after = jax.vmap(lambda state, now: step(plant, state, now[0], params, next_input=now[2]))(
        measured[:-1], steps
    )
    return jnp.concatenate([measured[:1], after]), plant.process_noise_sd


def require_likelihood(plant: AbstractPlant) -> bool:
    """Whether the state is observed; ValueError for process noise where it is not."""
    require_sensor_noise(plant)
    d = plant.definition
    if d.is_disturbed and not d.observes_state:
        raise ValueError(
            f"plant {d.name!r} has process noise, and its state is not observed: name its outputs "
            "as its states, without sensor noise, and give every state a noise_sd; or leave the "
            "process noise out"
        )
    return d.observes_state


def next_measurement(
    plant: AbstractPlant,
    before: Float[Array, " value"],
    input: Float[Array, " input"],
    params: Params,
    noise: Float[Array, " output"],
) -> Float[Array, " output"]:
    """What is measured after one step, of a static task or a plant whose state is observed.

    Args:
        before: what was measured before the step; a static task has no use for it.
        noise: standard normal.
    """
    if isinstance(plant, AbstractStaticTask):
        return plant.measured(input, params, noise)
    return step(plant, before, input, params) + plant.process_noise_sd * noise


def log_likelihood(
    plant: AbstractPlant,
    measured: Float[Array, " output"],
    before: Float[Array, " value"],
    input: Float[Array, " input"],
    params: Params,
) -> Float[Array, ""]:
    """Logarithm of the density of `next_measurement`, but for a constant."""
    if isinstance(plant, AbstractStaticTask):
        return plant.log_likelihood(measured, input, params)
    misses = (measured - step(plant, before, input, params)) / plant.process_noise_sd
    return -0.5 * jnp.sum(misses**2)


@eqx.filter_jit
def measure(
    plant: AbstractPlant,
    state: Float[Array, " state"],
    params: Params,
    output: Float[Array, " output"],
    noise: Float[Array, " output"],
) -> Float[Array, " output"]:
    """Measurement in a state, of a static task with its own noise.

    Args:
        output: what the sensor is shown.
        noise: standard normal.
    """
    if has_own_noise(plant):
        *design, is_made = state
        measured = plant.measured(jnp.stack(design), params, noise)
        return jnp.where(is_made > 0.5, measured, 0.0)
    return sensed(plant, output, noise)


@eqx.filter_jit
def sensed(
    plant: AbstractPlant, output: Float[Array, " output"], noise: Float[Array, " output"]
) -> Float[Array, " output"]:
    """Measurement of the outputs with given noise, in its standard deviations."""
    sensor = plant.sensor
    noisy = output + sensor.noise_sd * noise
    resolution = jnp.where(sensor.resolution > 0, sensor.resolution, 1.0)
    rounded = jnp.where(sensor.resolution > 0, jnp.round(noisy / resolution) * resolution, noisy)
    # Straight-through: rounding has no useful derivative, the measurement has.
    return noisy + jax.lax.stop_gradient(rounded - noisy)


def _delayed_step(
    past: Float[Array, "time input"], delay: Float[Array, " input"], k: Array
) -> tuple[Array, Array]:
    """`delayed` for step k of held inputs; the delay is in steps."""
    whole = jnp.floor(delay).astype(int)
    part, inputs = delay - whole, jnp.arange(past.shape[1])
    new, old = (past[jnp.maximum(k - whole - more, 0), inputs] for more in (0, 1))
    mean, half = new + part * (old - new), 3 * part * (1 - part) * (new - old)
    return mean - half, mean + half


@eqx.filter_jit
def run_episode(
    plant: AbstractPlant,
    params: Params,
    excitation: AbstractExcitation,
    num_steps: int,
    key: PRNGKeyArray,
    noise: Float[Array, "sample output"] | None = None,
) -> Trajectory:
    """One experiment in closed loop: measure, excite, clip to the limits, integrate.

    The noise depends on the key alone: with one key it is the same for every excitation.

    Args:
        noise: in place of that of the key, in standard deviations of the sensor.

    Raises:
        ValueError: for an excitation that measures, on a plant with feedthrough.
    """
    noise = sensor_noise(plant, num_steps, key) if noise is None else noise
    lower, upper = plant.input_limits
    if plant.has_feedthrough and excitation.uses_measurements:
        raise ValueError(
            f"an input of plant {plant.definition.name!r} acts on an output directly; with an "
            "excitation that measures, this is an algebraic loop: use a signal, such as chirp"
        )

    delay = plant.delay(params)

    def moved(state: Array, past: Array, input: Array, k: Array) -> tuple[Array, Array]:
        if delay is None:
            return step(plant, state, input, params), past
        past = past.at[k].set(input)
        first, last = _delayed_step(past, delay / plant.dt, k)
        return step(plant, state, first, params, next_input=last), past

    disturbance_key = jax.random.fold_in(key, 0)

    def sampled(state: Array, input: Array, noise: Array) -> tuple[Array, Array]:
        """The measurement and the true outputs; the input counts where there is feedthrough."""
        output, shown = plant.true_and_shown(state, *plant.feedthrough_input(input), params)
        return measure(plant, state, params, shown, noise), output

    def excited(memory: PyTree, measured: Array) -> tuple[PyTree, Array]:
        memory, input = excitation(memory, measured)
        return memory, jnp.clip(input, lower, upper)

    def advance(carry: tuple, now: tuple) -> tuple[tuple, tuple]:
        (state, past, memory), (noise, k) = carry, now
        if plant.has_feedthrough:  # the input is there before the measurement
            memory, input = excited(memory, jnp.zeros_like(noise))
            measured, output = sampled(state, input, noise)
        else:
            measured, output = sampled(state, jnp.zeros_like(lower), noise)
            memory, input = excited(memory, measured)
        state, past = moved(state, past, input, k)
        state = disturbed(plant, state, jax.random.fold_in(disturbance_key, k))
        return (state, past, memory), (input, measured, output)

    past = jnp.zeros((0 if delay is None else num_steps, len(lower)))
    start = plant.initial_state, past, excitation.init(plant, num_steps, jax.random.split(key)[0])
    steps = noise[:-1], jnp.arange(num_steps)
    (state, *_), (inputs, measured, outputs) = jax.lax.scan(advance, start, steps)
    final, last = sampled(state, inputs[-1], noise[-1])
    return Trajectory(
        time=jnp.arange(num_steps + 1) * plant.dt,
        inputs=inputs,
        measured=jnp.concatenate([measured, final[None]]),
        outputs=jnp.concatenate([outputs, last[None]]),
    )


@eqx.filter_jit
def sensor_noise(
    plant: AbstractPlant, num_steps: int, key: PRNGKeyArray
) -> Float[Array, "sample output"]:
    """The noise of `run_episode` with this key, in standard deviations of the sensor."""
    keys = jax.random.split(jax.random.split(key)[1], num_steps + 1)
    count = len(plant.definition.outputs)
    return jax.vmap(lambda own: jax.random.normal(own, (count,), float))(keys)


class DivergedError(ValueError):
    """A simulation with outputs that are not finite."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """All choices of one simulated experiment.

    Attributes:
        plant: with the sensor of this experiment.
        params: true ones.
        name: of the excitation.
        origin: entries of the record about a policy or a signal's file.
        num_steps: length [samples].
        seed: of the noise; a whole number or a JAX key.
    """

    plant: AbstractPlant
    params: Params
    excitation: AbstractExcitation
    name: str
    origin: Mapping[str, str]
    num_steps: int
    seed: int | PRNGKeyArray = 0

    @classmethod
    def of(
        cls,
        plant: PlantLike,
        excitation: ExcitationLike | None = None,
        *,
        options: Mapping[str, object] | None = None,
        steps: int | None = None,
        params: Mapping[str, float] | Params | None = None,
        noise: Mapping[str, float] | None = None,
        resolution: Mapping[str, float] | None = None,
        seed: int | PRNGKeyArray = 0,
        coast: int = 0,
    ) -> Experiment:
        """The experiment that `simulate` runs, with the same arguments.

        Raises:
            ValueError: for an unknown name or a value that is not allowed.
            TypeError: for an argument of another type.
        """
        chosen = with_sensor(plant_from(plant), noise, resolution)
        if isinstance(excitation, Record):
            chosen = chosen.changed(dt=excitation.dt)
        options = by_name("options", options)
        if excitation is None:
            excitation = usual_signal(chosen) if chosen.definition.inputs else NoInput()
        elif not chosen.definition.inputs and not isinstance(excitation, Record):
            raise ValueError(
                f"plant {chosen.definition.name!r} has no inputs: leave the excitation out"
            )
        name = excitation if isinstance(excitation, str) else name_of(excitation)
        found, origin = excitation_and_origin(excitation, options, chosen)
        source = excitation.source if isinstance(excitation, Record) else ""
        num_steps = experiment_length(found, source or name, steps, isinstance(excitation, Record))
        require_whole("coast", coast, 0)
        found, num_steps = Coast.after(found, num_steps, coast)
        values = params_from(chosen, params)
        _require_causal(chosen, values)
        return cls(chosen, values, found, name, origin, num_steps, _checked(seed))

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence where the policy was trained on another plant."""
        return tuple(text for word, text in self.origin.items() if word == "warning")

    @property
    def key(self) -> PRNGKeyArray:
        """The key of the excitation and of the sensor's noise."""
        return jax.random.key(self.seed) if isinstance(self.seed, int) else self.seed

    def run(self) -> Trajectory:
        """Inputs and outputs at all samples.

        Raises:
            DivergedError: where the simulation diverged.
        """
        run = run_episode(self.plant, self.params, self.excitation, self.num_steps, self.key)
        if not np.all(np.isfinite(run.outputs)):
            raise DivergedError(
                "the simulation diverged (NaN or infinity): these parameters make the plant too "
                "fast for its integration step, or unstable"
            )
        return run

    def record(self, run: Trajectory) -> Record:
        """The record: measurements, and how they were made."""
        is_number = isinstance(self.seed, int)
        seed = self.seed if is_number else jax.random.key_data(self.seed).tolist()
        names, description = names_of(self.plant.definition.parameters), self.plant.description
        metadata = {
            "plant": json_ready(description.to_dict()),
            "plant_hash": description.hash,
            "params": {n: float(v) for n, v in zip(names, self.params, strict=True)},
            "starts_at_initial_state": True,
            "provenance": {
                "excite": __version__,
                "simulated": True,
                "excitation": self.name,
                "seed": seed,
                **self.origin,
            },
        }
        return Record.of_episode(run.time, run.inputs, run.measured, metadata, "simulated record")


def experiment_length(
    excitation: AbstractExcitation, name: str, steps: int | None, is_record: bool
) -> int:
    """The requested length, or the excitation's; ValueError where that is shorter."""
    if steps is not None and (not isinstance(steps, int) or isinstance(steps, bool)):
        raise wrong_type("steps", steps, "a whole number")
    if steps is not None and steps < 2:
        raise ValueError(f"steps must be at least 2: got {steps}")
    if isinstance(excitation, PolicyExcitation):
        longest = usual = excitation.layout.num_steps
    elif isinstance(excitation, Replay):
        longest = len(excitation.inputs)
        usual = longest - is_record  # the last row of a record acts after its end
    else:
        return steps or 500
    if (steps or usual) > longest:
        raise ValueError(f"{name} was made for {longest} steps: got {steps}")
    return steps or usual


def _require_causal(plant: AbstractPlant, params: Params) -> None:
    """Raises ValueError where an input would act before it is chosen."""
    delay = plant.delay(params)
    for name, value in zip(
        names_of(plant.definition.inputs), () if delay is None else delay, strict=False
    ):
        if value < 0:
            raise ValueError(
                f"input {name!r} has a delay of {float(value):g} s; it must be zero or more in a "
                "simulation (only a recorded input can be late)"
            )


def _checked(seed: object) -> int | PRNGKeyArray:
    if isinstance(seed, jax.Array) and jnp.issubdtype(seed.dtype, jax.dtypes.prng_key):
        if seed.shape == ():
            return seed
    elif isinstance(seed, int | np.integer) and not isinstance(seed, bool):
        if 0 <= seed < 2**63:
            return int(seed)
        raise ValueError(f"seed must be 0 or more, and below 2^63: got {seed}")
    raise wrong_type("seed", seed, "a whole number or a key of jax.random.key")


def simulate(
    plant: PlantLike,
    excitation: ExcitationLike | None = None,
    *,
    options: Mapping[str, object] | None = None,
    steps: int | None = None,
    params: Mapping[str, float] | Params | None = None,
    noise: Mapping[str, float] | None = None,
    resolution: Mapping[str, float] | None = None,
    seed: int | PRNGKeyArray = 0,
    coast: int = 0,
) -> Record:
    """The record of one simulated experiment, with the measurements of the plant's sensor.

        >>> import excite as ex
        >>> record = ex.simulate("aero2", "prbs", params={"D_p": 0.0012}, steps=200, seed=1)
        >>> record.inputs.shape, record.outputs.shape
        ((201, 1), (201, 1))

    Args:
        plant: a name (`ex.plants()` lists them), `path/to/file.py:ClassName`, a plant or
            its class.
        excitation: a name (`ex.excitations()` lists them), an excitation or its class, a
            policy, the file of a policy or of a signal, a record to replay, or an array of
            inputs by sample and input [input units]. Default a chirp, for a task without memory
            random designs; a plant without inputs takes none.
        options: of the excitation, by name.
        steps: length [samples]; default 500, or that of a policy, a record or a signal.
        params: true parameters that differ from the nominal ones, by name or as the
            plant's named tuple.
        noise: standard deviation of an output's noise, by name [output unit].
        resolution: step of an output's encoder, by name [output unit].
        seed: of excitation and noise; a whole number or a JAX key.
        coast: samples after the excitation's end, under the input that ends an experiment.

    Raises:
        ValueError: for a name, an option or a value that is not allowed; `DivergedError`
            where the simulation diverged.
        TypeError: for an argument of another type.
    """
    experiment = Experiment.of(
        plant, excitation, options=options, steps=steps, params=params, noise=noise,
        resolution=resolution, seed=seed, coast=coast,
    )  # fmt: skip
    return experiment.record(experiment.run())
