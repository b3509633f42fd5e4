"""The real-time loop: one experiment on a rig, supervised and recorded; NumPy alone.

At every sampling instant: read, look at the reading, ask the player, limit what it wants,
apply it, record the sample. In between, every further reading of the rig is looked at. An
experiment ends by itself, by a trip of the supervisor, by a signal, or by an error of the
player, the rig or the disk. Each of these ends in the safe input, released hardware (the
rig is a context manager), a readable record, and a reason in it.
"""

from __future__ import annotations

import contextlib
import json
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..description import Output, display_unit
from ..files import json_text
from ..safety import Supervision, Trip, Watch, allowed, check_reading, check_sample, tripped
from .contract import AbstractRig, Reading, RigError, Sample
from .player import AbstractPlayer
from .recorder import Recorder

COMPLETE = "complete"

# Measurements that a record must not hold as if the plant had shown them.
_FALSE_MEASUREMENTS = (Trip.NOT_FINITE, Trip.JUMP)


@dataclass
class Outcome:
    """How an experiment went.

    Attributes:
        reason: why it ended: "complete", a trip's sentence, a signal, or an error's sentence.
        trip: the supervisor's reason, by name in lower case; none where it did not trip.
        num_samples: sampling instants that were played.
        max_abs_output: largest magnitude of every reading, by output.
        late: how late each reading came [s]; empty where time is not the wall's.
        num_missed: readings that came later than one whole interval.
        error: what went wrong, for a traceback.
        rig, player: what they say of themselves.
    """

    reason: str = COMPLETE
    trip: Trip = Trip.NONE
    num_samples: int = 0
    max_abs_output: np.ndarray = field(default_factory=lambda: np.zeros(0))
    late: list[float] = field(default_factory=list)
    num_missed: int = 0
    error: BaseException | None = None
    rig: dict[str, Any] = field(default_factory=dict)
    player: dict[str, Any] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """Whether the whole experiment was played."""
        return self.reason == COMPLETE

    def to_dict(self) -> dict[str, Any]:
        """The outcome as JSON-ready data."""
        late = np.array(self.late) * 1000
        points = (50, 90, 99, 100)
        spread = (
            dict(zip(map(str, points), np.percentile(late, points), strict=True))
            if self.late
            else None
        )
        return {
            "reason": self.reason,
            "trip": self.trip.name.lower(),
            "num_samples": self.num_samples,
            "max_abs_output": self.max_abs_output.tolist(),
            "late_ms_percentiles": spread,
            "missed_deadlines": self.num_missed,
            "rig": self.rig,
            "player": self.player,
        }

    def failed(self, what: str, error: BaseException) -> None:
        """Adds what went wrong after the experiment's end."""
        self.reason += f"; {what}: {_sentence(error)}"
        self.error = self.error or error


class Stop:
    """Asked to end: by a signal, of which it holds the name."""

    reason = ""


@contextlib.contextmanager
def interruptible() -> Iterator[Stop]:
    """Signals end an experiment at its next reading; a second one at once.

    Also the one that a terminal sends when it is closed.
    """
    stop, before = Stop(), {}

    def ask(number: int, _: object) -> None:
        if stop.reason:
            raise KeyboardInterrupt
        stop.reason = f"interrupted by {signal.Signals(number).name}"

    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK"):
        if (number := getattr(signal, name, None)) is not None:
            before[number] = signal.signal(number, ask)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass
class _Run:
    """An experiment under way, from its first reading on."""

    rig: AbstractRig
    rules: Supervision
    outcome: Outcome
    stop: Stop
    watch: Watch
    first: Reading
    last: Reading
    start: float
    num_steps: int
    num_readings: int = 0
    num_late: int = 0

    @classmethod
    def begin(
        cls, rig: AbstractRig, rules: Supervision, outcome: Outcome, stop: Stop, num_steps: int
    ) -> _Run:
        """At the first reading."""
        if not 0 <= rig.num_latency < rig.num_readings:
            raise RigError(
                f"the rig's latency of {rig.num_latency} readings must be less than the "
                f"{rig.num_readings} of one sampling time"
            )
        first, now = rig.read(), time.perf_counter()
        watch = Watch.start(np, rules, first.outputs)
        run = cls(rig, rules, outcome, stop, watch, first, first, now, num_steps)
        run.look(first)
        return run

    @property
    def is_over(self) -> bool:
        """Whether a trip or a signal ended it."""
        return bool(self.watch.trip != Trip.NONE or self.stop.reason)

    @property
    def time(self) -> float:
        """Of the last reading, since the first [s]."""
        return self.last.time - self.first.time

    def look(self, reading: Reading) -> None:
        """What the supervisor sees in a reading, and in when it came."""
        expected = self.rules.critical.shape
        if np.shape(reading.outputs) != expected:
            raise RigError(
                f"a reading of this plant has {expected[0]} outputs: got an array of shape "
                f"{np.shape(reading.outputs)}"
            )
        elapsed = reading.time - self.last.time
        self.watch = check_reading(np, self.rules, self.watch, reading.outputs, elapsed)
        self.last = reading
        if self.num_readings and not elapsed > 0:  # the same reading once more
            self.trip(Trip.STALE)
        size = np.nan_to_num(np.abs(reading.outputs), posinf=0.0)
        self.outcome.max_abs_output = np.maximum(self.outcome.max_abs_output, size)
        if self.rig.is_real_time:
            self._look_at_clock()
        self.num_readings += 1

    def lateness(self) -> float:
        """How long the next reading has been due [s]."""
        interval = self.rules.dt / self.rig.num_readings
        return time.perf_counter() - self.start - self.num_readings * interval

    def _look_at_clock(self) -> None:
        interval, late = self.rules.dt / self.rig.num_readings, self.lateness()
        if late < -self.rules.dt:
            raise RigError(
                f"readings come {-late:.3g} s before they are due: in real time `read` must wait"
            )
        self.outcome.late.append(late)
        self.num_late = self.num_late + 1 if late > interval else 0
        self.outcome.num_missed += late > interval
        # A whole sample late, or late in a row for as long as one: the plan no longer holds.
        if late > self.rules.dt or self.num_late > max(self.rig.num_readings, 2):
            self.trip(Trip.DEADLINES)

    def look_at_player(self) -> None:
        """Whether an input comes so late that it was meant for another state."""
        if self.rig.is_real_time and self.lateness() > self.rules.dt:
            self.trip(Trip.DEADLINES)

    def record(
        self,
        recorder: Recorder,
        on_sample: Callable[[Sample], None],
        k: int,
        input: np.ndarray,
    ) -> None:
        """The sample whose input begins to act now; not what the plant has not shown."""
        if recorder.num_samples == k and self.watch.trip not in _FALSE_MEASUREMENTS:
            recorder.append(input, self.last.outputs, self.last.time)
            if k < self.num_steps:
                on_sample(Sample(k, self.time, self.last.outputs, input))

    def trip(self, trip: Trip) -> None:
        """Ends the experiment for a reason that is not in the outputs."""
        self.watch = tripped(np, self.watch, np.True_, trip)

    def ended(self) -> None:
        """Writes the reason of an early end into the outcome."""
        self.outcome.trip = Trip(int(self.watch.trip))
        if self.outcome.trip != Trip.NONE:
            shown = ", ".join(map(_shown, self.rig.description.outputs, self.last.outputs))
            self.outcome.reason = f"{self.outcome.trip.sentence} ({shown} at {self.time:.2f} s)"
        elif self.stop.reason:
            self.outcome.reason = self.stop.reason


def _shown(output: Output, value: float) -> str:
    unit, factor = display_unit(output.unit)
    return f"{output.name} {factor * value:.4g} {unit}"


def run(
    rig: AbstractRig,
    player: AbstractPlayer,
    rules: Supervision,
    recorder: Recorder,
    *,
    stop: Stop | None = None,
    on_sample: Callable[[Sample], None] = lambda _: None,
) -> Outcome:
    """One experiment on an open rig, from its first reading to the safe input.

    Args:
        recorder: open, too; its sidecar is told how the experiment ended.
        stop: asks it to end.
        on_sample: called after the input of every sampling instant was applied.

    Nothing is raised for what ends an experiment early: the outcome says it.
    """
    outcome = Outcome(max_abs_output=np.zeros(len(rules.critical)))
    try:
        under_way = _Run.begin(rig, rules, outcome, stop or Stop(), player.num_steps)
        _play(under_way, player, recorder, on_sample)
        under_way.ended()
    except (Exception, KeyboardInterrupt) as error:
        outcome.reason, outcome.error = _sentence(error), error
    try:
        rig.write(rig.safe_input)
    except (Exception, KeyboardInterrupt) as error:
        outcome.failed("the safe input could not be applied", error)
    outcome.rig, outcome.player = _facts(rig), _facts(player)
    try:
        recorder.end(outcome.to_dict())
    except (Exception, KeyboardInterrupt) as error:  # so does a full disk
        outcome.failed("the record was not told", error)
    return outcome


def _facts(part: AbstractRig | AbstractPlayer) -> dict[str, Any]:
    """What it says of itself, or why it cannot: not even that may lose a record's end."""
    try:
        return json.loads(json_text(part.facts()))
    except (Exception, KeyboardInterrupt) as error:
        return {"error": _sentence(error)}


def _play(
    run: _Run,
    player: AbstractPlayer,
    recorder: Recorder,
    on_sample: Callable[[Sample], None],
) -> None:
    """Sampling instants until the experiment is over, and the measurement at its end."""
    rig, latency = run.rig, run.rig.num_latency
    for k in range(player.num_steps + 1):
        run.watch = check_sample(np, run.rules, run.watch)
        is_last = k == player.num_steps
        proposed = rig.safe_input if is_last or run.is_over else player(k, run.last.outputs)
        run.look_at_player()
        run.watch, input = allowed(np, run.rules, run.watch, proposed)
        rig.write(input)
        if not is_last:
            player.applied(input)
            run.outcome.num_samples = k + 1
        for i in range(rig.num_readings + 1):
            if i == latency:
                run.record(recorder, on_sample, k, input)
            if run.is_over or (is_last and i == latency):
                return
            if i < rig.num_readings:
                run.look(rig.read())
        planned = (k + 1) * run.rules.dt
        if abs(run.time - planned) > 0.02 * planned + 2 * run.rules.dt:
            run.trip(Trip.DURATION)


def _sentence(error: BaseException) -> str:
    """An error in words; the type where it has none of its own, or is no sentence of ours."""
    if isinstance(error, RigError | OSError):
        return str(error)
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    return f"{type(error).__name__}: {error}"
