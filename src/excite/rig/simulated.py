"""A simulated rig that behaves like a real one: detailed plant, latency, jitter, dropouts.

`Hardware` is the physics between two readings, a pure function. `SimulatedRig` steps it in
real time, or as fast as it can, as a rig. `run_batch` steps thousands in parallel with the
same rules of the supervisor. It continues after a trip, to test whether the safe input was
enough. The true parameters are shown only at the end.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, PyTree

from ..description import names_of
from ..environment import Episodes, scored
from ..excitation import AbstractExcitation
from ..plant import AbstractPlant, Params, draw_params
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
from ..simulation import Trajectory, measure, step
from .contract import AbstractRig, Pacer, Reading
from .filter import SafetyFilter


class HardwareState(eqx.Module):
    """State of a simulated rig.

    Attributes:
        plant_state: true state.
        acting: input that acts now.
        written: input that was written last.
        delay: time until that one acts [s].
        shown: last reading.
        n: number of readings so far.
        largest: largest magnitude of each true output.
    """

    plant_state: Float[Array, " state"]
    acting: Float[Array, " input"]
    written: Float[Array, " input"]
    delay: Float[Array, ""]
    shown: Float[Array, " output"]
    n: Int[Array, ""]
    largest: Float[Array, " output"]


class Hardware(eqx.Module):
    """Plant, parameters and faults of a simulated rig.

    Attributes:
        plant: with the interval between two readings as its dt.
        params: its true parameters.
        latency: mean time from writing an input to its action [s].
        jitter: half the range in which that time is drawn for every input [s].
        dropout: probability that a reading repeats the one before it.
        key: of noise, jitter and dropouts.
    """

    plant: AbstractPlant
    params: Params
    latency: Float[Array, ""]
    jitter: Float[Array, ""]
    dropout: Float[Array, ""]
    key: PRNGKeyArray

    @classmethod
    def draw(
        cls,
        plant: AbstractPlant,
        num_readings: int,
        spread: float,
        key: PRNGKeyArray,
        **numbers: float,
    ) -> Hardware:
        """Hardware with parameters drawn around the nominal ones.

        Args:
            plant: sampled as experiments are.
            num_readings: in one sampling time.
            spread: of the parameters, as a fraction of their scales.
            key: of the parameters, and of noise, jitter and dropouts.
            numbers: `latency`, `jitter`, `dropout`; by default a tenth of dt, a thousandth
                of dt, and zero.
        """
        params_key, rig_key = jax.random.split(key)
        dt = float(plant.dt)
        usual = {"latency": dt / 10, "jitter": dt / 1000, "dropout": 0.0} | numbers
        return cls(
            plant=at_interval(plant, num_readings),
            params=draw_params(plant, params_key, spread),
            key=rig_key,
            **{name: jnp.asarray(value, float) for name, value in usual.items()},
        )

    def start(self) -> HardwareState:
        """At rest, input zero, at the first reading."""
        plant = self.plant
        output = plant.output(plant.initial_state, self.params)
        rest = jnp.asarray(safe_input(plant.definition))
        shown = measure(plant, output, jax.random.fold_in(self.key, 0))
        largest = jnp.abs(plant.true_output(plant.initial_state, self.params))
        now, first = jnp.asarray(0.0), jnp.asarray(0)
        return HardwareState(plant.initial_state, rest, rest, now, shown, first, largest)

    def write(self, state: HardwareState, input: Float[Array, " input"]) -> HardwareState:
        """State after an input was written; it acts after latency and jitter."""
        late = jax.random.uniform(jax.random.fold_in(self.key, -1 - state.n), (), float, -1, 1)
        delay = jnp.maximum(self.latency + self.jitter * late, 0.0)
        return eqx.tree_at(lambda s: (s.written, s.delay), state, (input, delay))

    def advance(self, state: HardwareState) -> HardwareState:
        """State one interval later, at the next reading."""
        interval = self.plant.dt
        before = jnp.clip(state.delay, 0.0, interval)  # how long the earlier input still acts
        middle = self._moved(state.plant_state, state.acting, before)
        after = self._moved(middle, state.written, interval - before)
        output = self.plant.output(after, self.params)
        noise_key, dropout_key = jax.random.split(jax.random.fold_in(self.key, state.n + 1))
        measured = measure(self.plant, output, noise_key)
        is_lost = jax.random.uniform(dropout_key) < self.dropout
        return HardwareState(
            plant_state=after,
            acting=jnp.where(state.delay < interval, state.written, state.acting),
            written=state.written,
            delay=state.delay - interval,
            shown=jnp.where(is_lost, state.shown, measured),
            n=state.n + 1,
            largest=jnp.maximum(state.largest, jnp.abs(self.plant.true_output(after, self.params))),
        )

    def _moved(self, state: Array, input: Array, duration: Array) -> Array:
        """The plant's state after part of an interval."""
        plant = eqx.tree_at(lambda p: p.dt, self.plant, duration)
        return step(plant, state, input, self.params)


def at_interval(plant: AbstractPlant, num_readings: int) -> AbstractPlant:
    """The plant sampled at every reading, integrated no more coarsely than before."""
    return plant.changed(dt=float(plant.dt) / num_readings)


_advance = eqx.filter_jit(Hardware.advance)
_write = eqx.filter_jit(Hardware.write)


class SimulatedRig(AbstractRig):
    """Simulated hardware as a rig."""

    starts_at_rest = True

    def __init__(
        self, plant: AbstractPlant, hardware: Hardware, num_readings: int, is_real_time: bool
    ) -> None:
        """A rig of a plant.

        Args:
            plant: sampled as experiments are.
            hardware: the physics between readings.
            num_readings: in one sampling time.
            is_real_time: whether readings come in real time.

        Raises:
            ValueError: if an input would not act before the next one is written.
        """
        self.description = plant.description
        self.num_readings, self.is_real_time = num_readings, is_real_time
        self.num_latency = round(float(hardware.latency) * num_readings / float(plant.dt))
        if hardware.latency + hardware.jitter >= plant.dt or self.num_latency >= num_readings:
            raise ValueError(
                f"latency and jitter must be less than the sampling time of {plant.dt:g} s: "
                f"got {hardware.latency:g} and {hardware.jitter:g} s"
            )
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
        names = names_of(self.description.parameters)
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


class NoFilter(eqx.Module):
    """Lets every input pass, in place of a safety filter."""

    def start(self) -> None:
        """An empty memory."""

    def __call__(
        self, memory: None, measured: Float[Array, " output"], proposed: Float[Array, " input"]
    ) -> tuple[None, Float[Array, " input"], Bool[Array, ""]]:
        """The unchanged input."""
        del measured
        return memory, proposed, jnp.asarray(False)

    def is_over(self, memory: None) -> Bool[Array, ""]:
        """Never."""
        del memory
        return jnp.asarray(False)


NO_FILTER = NoFilter()


@eqx.filter_jit
def run_batch(
    hardware: Hardware,
    excitation: AbstractExcitation,
    rules: Supervision,
    num_steps: int,
    num_readings: int,
    safety_filter: SafetyFilter | NoFilter = NO_FILTER,
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
        return _one_run(hardware, excitation, rules, num_steps, num_readings, safety_filter)

    return jax.vmap(one)(hardware)


def _one_run(
    hardware: Hardware,
    excitation: AbstractExcitation,
    rules: Supervision,
    num_steps: int,
    num_readings: int,
    safety_filter: SafetyFilter | NoFilter,
) -> Runs:
    interval = rules.dt / num_readings
    latency = jnp.round(hardware.latency / interval).astype(int)

    def reading(carry: tuple, _: None) -> tuple[tuple, Array]:
        state, watch = carry
        state = hardware.advance(state)
        was_running = watch.trip == int(Trip.NONE)
        watch = check_reading(jnp, rules, watch, state.shown, interval)
        is_new = was_running & (watch.trip != int(Trip.NONE))
        safe = hardware.write(state, jnp.asarray(rules.safe_input, float))
        state = jax.tree.map(lambda a, b: jnp.where(is_new, a, b), safe, state)
        return (state, watch), state.shown

    def hold(state: HardwareState, watch: Watch, input: Array) -> tuple[tuple, Array]:
        """The readings of one sampling time, and the one at which the input begins to act."""
        now = state.shown
        carry = hardware.write(state, input), watch
        carry, shown = jax.lax.scan(reading, carry, None, length=num_readings)
        return carry, jnp.concatenate([now[None], shown])[latency]

    def sample(carry: tuple, _: None) -> tuple[tuple, tuple]:
        state, watch, player, memory, count = carry
        measured = watch.reading
        watch = check_sample(jnp, rules, watch)
        player, proposed = excitation(player, measured)
        memory, proposed, is_changed = safety_filter(memory, measured, proposed)
        watch = tripped(jnp, watch, safety_filter.is_over(memory), Trip.UNEXPLAINED)
        watch, input = allowed(jnp, rules, watch, proposed)
        player = excitation.applied(player, input)
        (state, watch), acted_on = hold(state, watch, input)
        return (state, watch, player, memory, count + is_changed), (input, acted_on)

    state = hardware.start()
    # A signal is made for the sampling time, not for the interval between two readings.
    plant = eqx.tree_at(lambda p: p.dt, hardware.plant, jnp.asarray(rules.dt))
    player = excitation.init(plant, num_steps, hardware.key)
    watch = Watch.start(jnp, rules, state.shown)
    carry = state, watch, player, safety_filter.start(), jnp.asarray(0)
    (state, watch, _, memory, count), (inputs, measured) = jax.lax.scan(
        sample, carry, None, length=num_steps
    )
    trip, safe = watch.trip, jnp.asarray(rules.safe_input, float)
    (state, _), last = hold(state, watch, safe)
    measured = jnp.concatenate([measured, last[None]])
    is_over = is_violation(state.largest[None], jnp.asarray(rules.critical))
    return Runs(state.largest, is_over, trip, count, inputs, measured, memory)


def drawn_hardware(
    plant: AbstractPlant,
    num_readings: int,
    spread: float,
    keys: Key[Array, " run"],
    **numbers: float,
) -> Hardware:
    """Hardware for each key, with the same plant as in `run_episodes`; see `Hardware.draw`."""

    def draw(key: PRNGKeyArray) -> Hardware:
        return Hardware.draw(plant, num_readings, spread, key, **numbers)

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
    safety_filter: SafetyFilter | NoFilter = NO_FILTER,
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
        time = jnp.arange(len(run.measured)) * plant.dt
        return scored(plant, params, Trajectory(time, run.inputs, run.measured, run.measured))

    episodes = jax.vmap(score)(params, runs)
    safety = runs.is_violation, runs.max_abs_output
    return eqx.tree_at(lambda e: (e.is_violation, e.max_abs_output), episodes, safety)
