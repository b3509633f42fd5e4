"""A simulated rig that behaves like a real one: detailed plant, latency, jitter, dropouts.

`Hardware` is the physics between two readings, a pure function. `SimulatedRig` steps it in
real time, or as fast as it can, as a rig. `run_batch` steps thousands in parallel with the
same rules of the supervisor. It continues after a trip, to test whether the safe input was
enough. The true parameters are shown only at the end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, PyTree

from ..description import SpreadLike, names_of
from ..environment import Episodes, scored
from ..excitation import AbstractExcitation
from ..plant import AbstractPlant, Params, draw_params, params_from, params_within
from ..plant.extension import extended
from ..plant.static import require_sensor_noise
from ..safety import (
    Supervision,
    Trip,
    Watch,
    allowed,
    check_reading,
    check_sample,
    is_violation,
    safe_input,
    tripped,
)
from ..simulation import Trajectory, sensed, step
from .contract import AbstractRig, Pacer, Reading
from .faults import NO_FAULTS, Faults
from .filter import AbstractFilter


class HardwareState(eqx.Module):
    """State of a simulated rig.

    Attributes:
        plant_state: true state.
        inputs: those written last, the newest at the end.
        due: time until each of them has come to the plant, whose delay is added [s].
        acting: input that acted last.
        followed: outputs as the sensor follows them.
        shown: last reading.
        n: number of readings so far.
        largest: largest magnitude of each true output.
    """

    plant_state: Float[Array, " state"]
    inputs: Float[Array, "written input"]
    due: Float[Array, " written"]
    acting: Float[Array, " input"]
    followed: Float[Array, " output"]
    shown: Float[Array, " output"]
    n: Int[Array, ""]
    largest: Float[Array, " output"]


class Hardware(eqx.Module):
    """Plant, parameters and faults of a simulated rig.

    Attributes:
        plant: the true one, with the interval between two readings as its dt.
        params: its true parameters.
        latency: mean time from writing an input to its action [s].
        jitter: half the range in which that time is drawn for every input [s].
        dropout: probability that a reading repeats the one before it.
        key: of noise, jitter and dropouts.
        faults: of sensor and actuator.
        num_written: number of inputs that are kept until they act, see `num_written`.
    """

    plant: AbstractPlant
    params: Params
    latency: Float[Array, ""]
    jitter: Float[Array, ""]
    dropout: Float[Array, ""]
    key: PRNGKeyArray
    faults: Faults = NO_FAULTS
    num_written: int = eqx.field(static=True, default=3)

    @classmethod
    def draw(
        cls,
        plant: AbstractPlant,
        num_readings: int,
        spread: SpreadLike,
        key: PRNGKeyArray,
        *,
        effects: Mapping[str, float] | None = None,
        faults: Faults = NO_FAULTS,
        **numbers: float,
    ) -> Hardware:
        """Hardware with parameters drawn around the nominal ones.

        Args:
            plant: sampled as experiments are.
            num_readings: in one sampling time.
            spread: of the parameters around their nominal values.
            key: of the parameters, and of noise, jitter and dropouts.
            effects: values of extensions that the true plant has and `plant` has not, by name:
                `gain_voltage`, `delay_voltage`, ...
            faults: of sensor and actuator.
            numbers: `latency`, `jitter`, `dropout`; by default a tenth of dt in whole
                readings, a thousandth of dt, and zero.
        """
        params_key, rig_key = jax.random.split(key)
        dt, given = float(plant.dt), effects or {}
        whole = extended(plant, list(given)) if given else plant
        own = draw_params(plant, params_key, spread)

        def true(own: Params) -> Params:
            return params_from(whole, given)._replace(**own._asdict())

        def delay(point: Array) -> Array | None:
            return whole.delay(true(params_within(plant, spread, point)))

        return cls(
            plant=at_interval(whole, num_readings),
            params=true(own),
            key=rig_key,
            faults=faults,
            num_written=num_written(delay, len(own), dt),
            **usual_numbers(dt, num_readings, numbers),
        )

    def start(self, noise: Float[Array, " output"] | None = None) -> HardwareState:
        """At the plant's initial state, input zero, at the first reading.

        Args:
            noise: of the reading in standard deviations, in place of that of the key.
        """
        plant = self.plant
        output = plant.output(plant.initial_state, self.params)
        rest, now = jnp.asarray(safe_input(plant.definition)), jnp.asarray(0.0)
        noise = self._noise(jax.random.fold_in(self.key, 0)) if noise is None else noise
        return HardwareState(
            plant_state=plant.initial_state,
            inputs=jnp.tile(rest, (self.num_written, 1)),
            due=jnp.zeros(self.num_written),
            acting=rest,
            followed=output,
            shown=sensed(plant, output + self.faults.bias(now), noise),
            n=jnp.asarray(0),
            largest=jnp.abs(plant.true_output(plant.initial_state, self.params)),
        )

    def write(self, state: HardwareState, input: Float[Array, " input"]) -> HardwareState:
        """State after an input was written; it acts after latency and jitter, and in order."""
        late = jax.random.uniform(jax.random.fold_in(self.key, -1 - state.n), (), float, -1, 1)
        due = jnp.maximum(self.latency + self.jitter * late, jnp.maximum(state.due[-1], 0.0))
        written = (
            jnp.concatenate([state.inputs[1:], input[None]]),
            jnp.concatenate([state.due[1:], due[None]]),
        )
        return eqx.tree_at(lambda s: (s.inputs, s.due), state, written)

    def advance(
        self, state: HardwareState, noise: Float[Array, " output"] | None = None
    ) -> HardwareState:
        """State one interval later, at the next reading; noise as for `start`."""
        interval = self.plant.dt
        before, now = state.n * interval, (state.n + 1) * interval
        arriving = self._arriving(state)
        # Up to the first input that arrives in the interval, and after it.
        first = jnp.min(jnp.where(arriving > 0, arriving, interval), initial=interval)
        middle, _ = self._moved(
            state, state.plant_state, arriving, (jnp.asarray(0.0), first), before
        )
        after, acting = self._moved(state, middle, arriving, (first, interval), before)
        output = self.plant.output(after, self.params)
        noise_key, dropout_key = jax.random.split(jax.random.fold_in(self.key, state.n + 1))
        followed = self.faults.followed(output, state.followed, interval)
        noise = self._noise(noise_key) if noise is None else noise
        measured = sensed(self.plant, followed + self.faults.bias(now), noise)
        is_lost = jax.random.uniform(dropout_key) < self.dropout
        return HardwareState(
            plant_state=after,
            inputs=state.inputs,
            due=state.due - interval,
            acting=acting,
            followed=followed,
            shown=jnp.where(is_lost | self.faults.is_frozen(now), state.shown, measured),
            n=state.n + 1,
            largest=jnp.maximum(state.largest, jnp.abs(self.plant.true_output(after, self.params))),
        )

    def _arriving(self, state: HardwareState) -> Float[Array, "later input"]:
        """Time until each input but the oldest acts on the plant [s], by channel."""
        delay, due = self.plant.delay(self.params), state.due[1:, None]
        delay = jnp.zeros(state.inputs.shape[1]) if delay is None else jnp.maximum(delay, 0.0)
        return due + delay[None]

    def _moved(
        self,
        state: HardwareState,
        plant_state: Float[Array, " state"],
        arriving: Float[Array, "later input"],
        part: tuple[Array, Array],
        time: Float[Array, ""],
    ) -> tuple[Float[Array, " state"], Float[Array, " input"]]:
        """The plant's state after a part of the interval, and what acts at its end.

        Where inputs change within the part, a linear input has their mean and first moment, as
        in `simulation.delayed`.
        """
        begin, end = part
        duration = end - begin
        share = jnp.clip((end - arriving) / jnp.where(duration > 0, duration, 1.0), 0.0, 1.0)
        share = jnp.where(arriving <= begin, 1.0, share)
        change = jnp.diff(state.inputs, axis=0)
        mean = state.inputs[0] + jnp.sum(share * change, axis=0)
        half = jnp.sum(3 * share * (1 - share) * change, axis=0)
        last = state.inputs[0] + jnp.sum(jnp.where(arriving <= end, change, 0.0), axis=0)
        from_input, to_input, last = (
            self.faults.acting(input, state.acting, time)
            for input in (mean - half, mean + half, last)
        )
        moved = step(self.plant, plant_state, from_input, self.params, duration, to_input)
        return moved, last

    def repeated(self, experiment: int) -> Hardware:
        """The same hardware after some experiments, with noise that it did not have before."""
        # Readings take the small numbers.
        key = jax.random.fold_in(self.key, 2**32 - experiment) if experiment else self.key
        return eqx.tree_at(lambda own: own.key, self, key)

    def reading_noise(self, num_readings: int) -> Float[Array, "reading output"]:
        """The noise of the first readings, in standard deviations of the sensor."""
        first = self._noise(jax.random.fold_in(self.key, 0))

        def later(n: Array) -> Array:
            return self._noise(jax.random.split(jax.random.fold_in(self.key, n))[0])

        others = jax.vmap(later)(jnp.arange(1, num_readings))
        return jnp.concatenate([first[None], others])

    def _noise(self, key: PRNGKeyArray) -> Float[Array, " output"]:
        return jax.random.normal(key, (len(self.plant.definition.outputs),), float)


def usual_numbers(
    dt: float, num_readings: int, given: Mapping[str, float]
) -> dict[str, Float[Array, ""]]:
    """Latency, jitter and dropout of a simulated rig, where they are not given.

    The usual latency is a tenth of dt in whole readings: a record can take no other into account.
    """
    latency = round(num_readings / 10) * dt / num_readings
    usual = {"latency": latency, "jitter": dt / 1000, "dropout": 0.0}
    return {name: jnp.asarray(value, float) for name, value in (usual | dict(given)).items()}


def num_written(delay: Callable[[Array], Array | None], num_coordinates: int, dt: float) -> int:
    """Number of inputs that a rig keeps until they act.

    Args:
        delay: of a plant at a point of [-1, 1]^num_coordinates; each adds its part to it.
        num_coordinates: of the point.
        dt: sampling time [s].
    """
    middle = delay(jnp.zeros(num_coordinates))
    if middle is None:
        return 3  # the one that acts, the one that comes, and a safe input after a trip
    longest = np.asarray(middle)
    for end in jnp.eye(num_coordinates):
        there = np.array([delay(end), delay(-end)])
        longest = longest + np.max(np.abs(there - np.asarray(middle)), axis=0)
    return 3 + max(0, math.ceil(np.max(longest) / dt - 1e-9))


def at_interval(plant: AbstractPlant, num_readings: int) -> AbstractPlant:
    """The plant sampled at every reading, integrated no more coarsely than before."""
    return plant.changed(dt=float(plant.dt) / num_readings)


_advance = eqx.filter_jit(Hardware.advance)
_write = eqx.filter_jit(Hardware.write)


class SimulatedRig(AbstractRig):
    """Simulated hardware as a rig."""

    def __init__(
        self, plant: AbstractPlant, hardware: Hardware, num_readings: int, is_real_time: bool
    ) -> None:
        """A rig of a plant.

        Args:
            plant: as it is known, sampled as experiments are.
            hardware: the physics between readings; its plant may be another.
            num_readings: in one sampling time.
            is_real_time: whether readings come in real time.

        Raises:
            ValueError: if an input would not act before the next one is written; for a task with
                its own noise.
        """
        require_sensor_noise(plant)
        self.description = plant.description
        self.num_readings, self.is_real_time = num_readings, is_real_time
        self.num_latency = round(float(hardware.latency) * num_readings / float(plant.dt))
        if hardware.latency + hardware.jitter >= plant.dt or self.num_latency >= num_readings:
            raise ValueError(
                f"latency and jitter must be less than the sampling time of {plant.dt:g} s: "
                f"got {hardware.latency:g} and {hardware.jitter:g} s"
            )
        start = hardware.plant.initial_state[: len(plant.initial_state)]
        self.starts_at_rest = bool(jnp.all(start == plant.initial_state))
        self._hardware, self._interval = hardware, float(plant.dt) / num_readings

    def open(self) -> None:
        """Starts at rest; compiles what a reading needs, so that the first is not late."""
        self._state = self._hardware.start()
        state, safe = self._state, jnp.asarray(self.safe_input)
        for _ in range(2):  # after a step, the state has another type for the compiler
            state = _advance(
                self._hardware, _advance(self._hardware, _write(self._hardware, state, safe))
            )
        self._pacer, self._count = Pacer(self._interval), -1

    def read(self) -> Reading:
        """The next reading; in real time when it is due."""
        self._count += 1
        if self._count:
            self._state = _advance(self._hardware, self._state)
        if self.is_real_time:
            self._pacer.wait()
        return Reading(self._count * self._interval, np.array(self._state.shown))

    def write(self, input: np.ndarray) -> None:
        """Applies an input, after the latency."""
        self._state = _write(self._hardware, self._state, jnp.asarray(input, float))

    def close(self) -> None:
        """Nothing to release."""

    def facts(self) -> Mapping[str, Any]:
        """True parameters and largest true outputs."""
        names = names_of(self._hardware.plant.definition.parameters)
        return {
            "simulated": True,
            "true_params": dict(zip(names, map(float, self._hardware.params), strict=True)),
            "true_max_abs_output": np.asarray(self._state.largest).tolist(),
        }


class Runs(eqx.Module):
    """A batch of experiments on simulated rigs; the leading axis is the run.

    Attributes:
        max_abs_output: largest magnitude of each true output at a reading.
        is_violation: whether a critical level was reached, also after a trip.
        trip: a `Trip`.
        num_interventions: samples at which a filter changed the input.
        inputs: of each sampling time.
        measured: when the inputs begin to act, and at the end; as a record has them.
        memory: of the filter or guard at the end.
    """

    max_abs_output: Float[Array, "*run output"]
    is_violation: Bool[Array, "*run"]
    trip: Int[Array, "*run"]
    num_interventions: Int[Array, "*run"]
    inputs: Float[Array, "*run time input"]
    measured: Float[Array, "*run sample output"]
    memory: PyTree = None


class NoFilter(AbstractFilter):
    """Lets every input pass, in place of a safety filter."""

    def start(self) -> None:
        """An empty memory."""

    def __call__(
        self, memory: None, measured: Float[Array, " output"], proposed: Float[Array, " input"]
    ) -> tuple[None, Float[Array, " input"], Bool[Array, ""]]:
        """The unchanged input."""
        del measured
        return memory, proposed, jnp.asarray(False)


NO_FILTER = NoFilter()


@eqx.filter_jit
def run_batch(
    hardware: Hardware,
    excitation: AbstractExcitation,
    rules: Supervision,
    num_steps: int,
    num_readings: int,
    safety_filter: AbstractFilter = NO_FILTER,
) -> Runs:
    """One experiment for each hardware, as the real-time loop would run it.

    Args:
        hardware: its leading axis is the run.
        excitation: proposes the inputs.
        rules: of the supervisor.
        num_steps: number of sampling instants.
        num_readings: in one sampling time.
        safety_filter: between excitation and supervisor.
    """

    def one(hardware: Hardware) -> Runs:
        return one_run(hardware, excitation, rules, num_steps, num_readings, safety_filter)

    return jax.vmap(one)(hardware)


def one_run(
    hardware: Hardware,
    excitation: AbstractExcitation,
    rules: Supervision,
    num_steps: int,
    num_readings: int,
    safety_filter: AbstractFilter,
    noise: Float[Array, "reading output"] | None = None,
    key: PRNGKeyArray | None = None,
) -> Runs:
    """One experiment; see `run_batch`.

    Args:
        key: of the excitation; default the hardware's.
        noise: of all readings in standard deviations, one of the start and num_readings of each
            sample, the filter's and one at the end included; default that of the hardware's key.
    """
    length = num_steps + safety_filter.num_more
    interval = rules.dt / num_readings
    latency = jnp.round(hardware.latency / interval).astype(int)

    def reading(carry: tuple, noise: Array | None) -> tuple[tuple, Array]:
        state, watch = carry
        state = hardware.advance(state, noise)
        was_running = watch.trip == int(Trip.NONE)
        watch = check_reading(jnp, rules, watch, state.shown, interval)
        is_new = was_running & (watch.trip != int(Trip.NONE))
        safe = hardware.write(state, jnp.asarray(rules.safe_input, float))
        state = jax.tree.map(lambda a, b: jnp.where(is_new, a, b), safe, state)
        return (state, watch), state.shown

    def hold(
        state: HardwareState, watch: Watch, input: Array, noise: Array | None
    ) -> tuple[tuple, Array]:
        """The readings of one sampling time, and the one at which the input begins to act."""
        now = state.shown
        carry = hardware.write(state, input), watch
        carry, shown = jax.lax.scan(reading, carry, noise, length=num_readings)
        return carry, jnp.concatenate([now[None], shown])[latency]

    @jax.checkpoint  # a gradient keeps the states at sampling instants alone
    def sample(carry: tuple, noise: Array | None) -> tuple[tuple, tuple]:
        state, watch, player, memory, count = carry
        measured = watch.reading
        watch = check_sample(jnp, rules, watch)
        player, proposed = excitation(player, measured)
        memory, proposed, is_changed = safety_filter(memory, measured, proposed)
        watch = tripped(jnp, watch, safety_filter.is_over(memory), Trip.UNEXPLAINED)
        watch, input = allowed(jnp, rules, watch, proposed)
        player, memory = excitation.applied(player, input), safety_filter.applied(memory, input)
        (state, watch), acted_on = hold(state, watch, input, noise)
        return (state, watch, player, memory, count + is_changed), (input, acted_on)

    first = by_sample = last = None
    if noise is not None:
        first, later = noise[0], noise[1:].reshape(length + 1, num_readings, -1)
        by_sample, last = later[:-1], later[-1]
    state = hardware.start(first)
    # A signal is made for the sampling time, not for the interval between two readings.
    plant = eqx.tree_at(lambda p: p.dt, hardware.plant, jnp.asarray(rules.dt))
    player = excitation.init(plant, num_steps, hardware.key if key is None else key)
    watch = Watch.start(jnp, rules, state.shown)
    carry = state, watch, player, safety_filter.start(), jnp.asarray(0)
    (state, watch, _, memory, count), (inputs, measured) = jax.lax.scan(
        sample, carry, by_sample, length=length
    )
    trip, safe = watch.trip, jnp.asarray(rules.safe_input, float)
    (state, _), last_acted_on = hold(state, watch, safe, last)
    measured = jnp.concatenate([measured, last_acted_on[None]])
    is_over = is_violation(state.largest[None], jnp.asarray(rules.critical))
    return Runs(state.largest, is_over, trip, count, inputs, measured, memory)


def drawn_hardware(
    plant: AbstractPlant,
    num_readings: int,
    spread: SpreadLike,
    keys: Key[Array, " run"],
    **options: Any,
) -> Hardware:
    """Hardware for each key, with the same plant as in `run_episodes`; see `Hardware.draw`."""

    def draw(key: PRNGKeyArray) -> Hardware:
        return Hardware.draw(plant, num_readings, spread, key, **options)

    return eqx.filter_vmap(draw)(keys)


def readings_per_sample(plant: AbstractPlant) -> int:
    """Readings of a simulated rig in one sampling time, at 500 Hz."""
    return max(1, round(500 * float(plant.dt)))


def evaluate_on_rig(
    plant: AbstractPlant,
    excitation: AbstractExcitation,
    hardware: Hardware,
    rules: Supervision,
    num_steps: int,
    safety_filter: AbstractFilter = NO_FILTER,
) -> tuple[Episodes, Runs]:
    """One experiment for each hardware, scored as `run_episodes` scores those on plants.

    Information and estimates are those of the whole experiment, also after a trip. A
    critical level counts as reached at any reading.

    Args:
        plant: as identification knows it.
        excitation: proposes the inputs.
        hardware: its leading axis is the run, see `drawn_hardware`.
        rules: of the supervisor.
        num_steps: number of sampling instants.
        safety_filter: between excitation and supervisor.
    """
    num_readings = readings_per_sample(plant)
    runs = run_batch(hardware, excitation, rules, num_steps, num_readings, safety_filter)
    return _scored(plant, hardware.params, runs), runs


@eqx.filter_jit
def _scored(plant: AbstractPlant, params: Params, runs: Runs) -> Episodes:
    """Every run as an experiment; its safety is that of all readings, not only of samples."""

    def score(params: Params, run: Runs) -> Episodes:
        known = plant.Params(*(getattr(params, name) for name in plant.Params._fields))
        time = jnp.arange(len(run.measured)) * plant.dt
        return scored(plant, known, Trajectory(time, run.inputs, run.measured, run.measured))

    episodes = jax.vmap(score)(params, runs)
    safety = runs.is_violation, runs.max_abs_output
    return eqx.tree_at(lambda e: (e.is_violation, e.max_abs_output), episodes, safety)
