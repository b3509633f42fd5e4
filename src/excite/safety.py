"""Warning and critical level of an output, and a supervisor's rules, over arrays.

The functions are pure and use only what NumPy and JAX arrays share (`xp` is the module of
array functions): a batch of thousands of simulated runs and a loop in real time are judged
by the same code. A level of infinity means no level. Axis 0 of one episode is time, axis 1
output; JAX maps over episodes with `vmap`, NumPy by broadcasting.

The supervisor is independent of the excitation. `check_reading` checks every reading,
`check_sample` those at sampling instants, `allowed` every input. After the first reason to
trip only the safe input is allowed.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import numpy as np

from .description import PlantDescription
from .policy import AnyArray


def critical_levels(description: PlantDescription) -> np.ndarray:
    """Critical level of each output's magnitude, in its unit; infinity for none."""
    levels = [
        math.inf if o.critical_level is None else o.critical_level for o in description.outputs
    ]
    return np.array(levels)


def safe_input(description: PlantDescription) -> np.ndarray:
    """Input that ends an experiment: zero, or the limit nearest to it."""
    return np.clip(
        0.0, [i.lower for i in description.inputs], [i.upper for i in description.inputs]
    )


def watched_output(description: PlantDescription) -> int:
    """Index of the first output with a critical level, else of the first output."""
    levels = critical_levels(description)
    return next((i for i, level in enumerate(levels) if level < math.inf), 0)


def watched_levels(
    description: PlantDescription,
) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
    """Indices of the outputs with a critical level, their warning and critical levels.

    Where an output has no warning level, the critical one takes its place.
    """
    parts = [(i, o) for i, o in enumerate(description.outputs) if o.critical_level is not None]
    critical = np.array([o.critical_level for _, o in parts], float)
    warning = [o.warning_level for _, o in parts]
    warning = np.array([c if w is None else w for w, c in zip(warning, critical, strict=True)])
    return tuple(i for i, _ in parts), warning.astype(float), critical


def penalty(outputs: AnyArray, warning: AnyArray, critical: AnyArray) -> AnyArray:
    """Stepwise safety penalty, at most zero: Eq. 3 of Langschwert et al., summed over outputs.

    Args:
        outputs: true outputs that have a critical level, the last axis.
        warning: their warning levels.
        critical: their critical levels.
    """
    magnitude = abs(outputs)
    is_over = magnitude >= critical
    is_near = (magnitude >= warning) & ~is_over
    over = 1 + 2 * (magnitude - critical) / critical
    near = 0.1 * ((magnitude - warning) / (critical - warning + (critical == warning))) ** 2
    return -(is_over * over + is_near * near).sum(axis=-1)


def max_abs_output(outputs: AnyArray) -> AnyArray:
    """Largest magnitude of each output over time."""
    return abs(outputs).max(axis=-2)


def is_violation(outputs: AnyArray, levels: AnyArray) -> AnyArray:
    """Whether an episode reaches the critical level of any output at any sample.

    Args:
        outputs: true (noise-free) outputs, time and output the last two axes.
        levels: critical level of each output.

    NaN counts as a violation: a run that cannot be computed is not a safe run.
    """
    return ~(max_abs_output(outputs) < levels).all(axis=-1)


class Trip(enum.IntEnum):
    """Why the supervisor ended an experiment."""

    NONE = 0
    LEVEL = 1
    PREDICTED_LEVEL = 2
    NOT_FINITE = 3
    JUMP = 4
    STALE = 5
    INPUT_NOT_FINITE = 6
    DEADLINES = 7
    DURATION = 8
    UNEXPLAINED = 9

    @property
    def sentence(self) -> str:
        """What happened, as a sentence."""
        return _TRIPS[self]


_TRIPS = {
    Trip.NONE: "",
    Trip.LEVEL: "an output reached its critical level",
    Trip.PREDICTED_LEVEL: "an output was about to reach its critical level",
    Trip.NOT_FINITE: "a measurement was not a finite number",
    Trip.JUMP: "a measurement jumped",
    Trip.STALE: "a measurement did not change while the plant was moving or driven",
    Trip.INPUT_NOT_FINITE: "the excitation asked for an input that is not a finite number",
    Trip.DEADLINES: "deadlines were missed",
    Trip.DURATION: "the rig's clock is too fast or too slow",
    Trip.UNEXPLAINED: "no plant of the declared uncertainty explains the measurements",
}


@dataclass(frozen=True, eq=False)  # hashable: a static argument of compiled functions
class Supervision:
    """Rules of a supervisor; arrays are by input or output, in their units.

    Attributes:
        dt: sampling time [s].
        lower, upper: input limits.
        slew: largest change of an input in one dt; infinite for any.
        safe_input: what is applied after a trip.
        critical: critical levels.
        resolution: smallest change of a reading that is not the sensor's noise or step.
        fastest: largest plausible change of an output in one second.
        widest: largest plausible change from one sampling instant to the next, for a rig that is
            read once in a sampling time.
        driven: an input further than this from the safe one must move the plant.
        num_still: samples for which a reading may be constant after the plant moved.
        num_dead: samples for which a reading may be constant while the plant is driven.
        is_guarded: whether levels, jumps and constant readings are left to a guard, which brakes
            where a supervisor can only switch to the safe input (`rig.guard`).
    """

    dt: float
    lower: np.ndarray
    upper: np.ndarray
    slew: np.ndarray
    safe_input: np.ndarray
    critical: np.ndarray
    resolution: np.ndarray
    fastest: np.ndarray
    widest: np.ndarray
    driven: np.ndarray
    num_still: int = 4
    num_dead: int = 20
    is_guarded: bool = False

    @classmethod
    def of(cls, description: PlantDescription, slew: float = math.inf) -> Supervision:
        """The rules for a plant.

        Args:
            slew: largest change of every input in one second, in its unit.

        Raises:
            ValueError: for a slew that is not positive.
        """
        if not slew > 0:
            raise ValueError(f"the slew limit must be positive: got {slew:g}")
        d = description
        lower, upper = (np.array([getattr(i, n) for i in d.inputs]) for n in ("lower", "upper"))
        critical = critical_levels(d)
        size = np.where(np.isfinite(critical), critical, [o.scale for o in d.outputs])
        return cls(
            dt=d.dt,
            lower=lower,
            upper=upper,
            slew=np.full(len(d.inputs), slew * d.dt),
            safe_input=safe_input(d),
            critical=critical,
            resolution=np.array([max(o.resolution, o.noise_sd) for o in d.outputs]),
            fastest=10 * size,
            widest=2 * size,
            driven=np.array([i.amplitude / 4 for i in d.inputs]),
        )


class Watch(NamedTuple):
    """State of a supervisor.

    Attributes:
        input: applied last.
        reading: last outputs.
        samples: outputs at the last three sampling instants, newest last.
        num_samples: number of sampling instants so far.
        num_still: by output, number of samples for which it has been constant.
        last_move: by output, size of the last change between samples.
        num_driven: by output, samples with large inputs since it last changed.
        trip: a `Trip`.
    """

    input: AnyArray
    reading: AnyArray
    samples: AnyArray
    num_samples: AnyArray
    num_still: AnyArray
    last_move: AnyArray
    num_driven: AnyArray
    trip: AnyArray

    @classmethod
    def start(cls, xp: ModuleType, rules: Supervision, measured: AnyArray) -> Watch:
        """State before the first sample, at the first reading."""
        count = len(rules.critical)
        return cls(
            input=xp.asarray(rules.safe_input, float),
            reading=xp.asarray(measured),
            samples=xp.stack([measured] * 3),
            num_samples=xp.asarray(0),
            num_still=xp.zeros(count, int),
            last_move=xp.zeros(count),
            num_driven=xp.zeros(count, int),
            trip=xp.asarray(int(Trip.NONE)),
        )


def tripped(xp: ModuleType, watch: Watch, condition: AnyArray, trip: Trip) -> Watch:
    """The watch after a condition for a trip was checked; the first trip is kept."""
    is_first = condition & (watch.trip == int(Trip.NONE))
    return watch._replace(trip=xp.where(is_first, int(trip), watch.trip))


def check_reading(
    xp: ModuleType, rules: Supervision, watch: Watch, measured: AnyArray, elapsed: AnyArray
) -> Watch:
    """The watch after one reading.

    Args:
        measured: outputs.
        elapsed: time since the last reading [s].
    """
    is_finite = xp.isfinite(measured)
    change = abs(xp.where(is_finite, measured, 0.0) - watch.reading)
    watch = tripped(xp, watch, ~is_finite.all(), Trip.NOT_FINITE)
    # Read once in a sampling time, a fast plant can go from one level to the other unseen.
    allowed_change = rules.fastest * elapsed + 8 * rules.resolution
    is_whole = elapsed > 0.75 * rules.dt
    allowed_change = xp.where(is_whole, xp.maximum(allowed_change, rules.widest), allowed_change)
    if not rules.is_guarded:
        watch = tripped(xp, watch, (is_finite & (change > allowed_change)).any(), Trip.JUMP)
        watch = tripped(xp, watch, (abs(measured) >= rules.critical).any(), Trip.LEVEL)
    return watch._replace(reading=xp.where(is_finite, measured, watch.reading))


def about_to_reach(samples: AnyArray, critical: AnyArray) -> AnyArray:
    """Whether each output is near its level, and reaches it one sample later.

    A parabola through the last three samples takes into account that a swing slows down before it
    turns. It says nothing of a plant that turns within a sample.

    Args:
        samples: the last three, axis 0, newest last; output is the last axis.
        critical: level of each output.
    """
    predicted = 3 * samples[2] - 3 * samples[1] + samples[0]
    is_smooth = abs(samples[2] - 2 * samples[1] + samples[0]) < 0.25 * critical
    return is_smooth & (abs(predicted) >= critical) & (abs(samples[2]) >= 0.9 * critical)


def check_sample(xp: ModuleType, rules: Supervision, watch: Watch) -> Watch:
    """The watch at a sampling instant: prediction one step ahead, and constant readings."""
    newest, last = watch.reading, watch.samples[2]
    samples = xp.concatenate([watch.samples[1:], newest[None]])
    if not rules.is_guarded:
        is_over = about_to_reach(samples, rules.critical).any() & (watch.num_samples >= 2)
        watch = tripped(xp, watch, is_over, Trip.PREDICTED_LEVEL)
    is_still = (newest == last) & (watch.num_samples > 0)
    is_driven = (abs(watch.input - rules.safe_input) > rules.driven).any()
    watch = watch._replace(
        samples=samples,
        num_samples=watch.num_samples + 1,
        num_still=xp.where(is_still, watch.num_still + 1, 0),
        last_move=xp.where(is_still, watch.last_move, abs(newest - last)),
        num_driven=xp.where(is_still, watch.num_driven + is_driven, 0),
    )
    # A swing slows down before it turns: a sudden stop is a fault of the sensor.
    is_stuck = (watch.num_still >= rules.num_still) & (watch.last_move > 4 * rules.resolution)
    is_dead = watch.num_driven >= rules.num_dead
    if rules.is_guarded:
        return watch
    return tripped(xp, watch, (is_stuck | is_dead).any(), Trip.STALE)


def allowed(
    xp: ModuleType, rules: Supervision, watch: Watch, proposed: AnyArray
) -> tuple[Watch, AnyArray]:
    """The watch, and the proposed input within limits and slew; the safe one after a trip."""
    watch = tripped(xp, watch, ~xp.isfinite(proposed).all(), Trip.INPUT_NOT_FINITE)
    near = xp.clip(proposed, watch.input - rules.slew, watch.input + rules.slew)
    near = xp.clip(near, rules.lower, rules.upper)
    input = xp.where(watch.trip == int(Trip.NONE), near, xp.asarray(rules.safe_input))
    return watch._replace(input=input), input
