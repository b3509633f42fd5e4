"""The real-time loop: one experiment on a rig, supervised and recorded; NumPy alone.

At every sampling instant: read, check the reading, ask the player for an input, limit it,
apply it, record the sample. Every reading in between is checked too. An experiment ends
when it is complete, by a trip of the supervisor, by a signal (Ctrl-C), or by an error of
the player, the rig or the disk, also one that ends the program (`SystemExit`). In each case
the safe input is applied, the hardware is released (the rig is a context manager), and the
record is readable and has the reason.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import FrameType

import numpy as np

from ..description import Output, display_unit
from ..files import json_text
from ..safety import Supervision, Trip, Watch, allowed, check_reading, check_sample, tripped
from .contract import AbstractRig, Reading, RigError, Sample
from .player import AbstractPlayer
from .recorder import Recorder
from .watchdog import SIGNALS

COMPLETE = "complete"
ENDS_OF_PROGRAM = (SystemExit, GeneratorExit)
"""They end the experiment, are recorded, and are then raised again by `session.run`."""

_PATIENCE = 2.0  # seconds after a first signal in which another one changes nothing
_PERCENTILES = (50, 90, 99, 100)

# After these trips the last reading is not a measurement of the plant, and is not recorded.
_FALSE_MEASUREMENTS = (Trip.NOT_FINITE, Trip.JUMP)


@dataclass
class Outcome:
    """How an experiment ended.

    Attributes:
        reason: "complete", or one sentence: a trip, a signal or an error.
        trip: why the supervisor ended it; `Trip.NONE` if it did not.
        num_samples: sampling instants played.
        max_abs_output: largest magnitude of each output over all readings, in its unit.
        late: delay of each reading [s]; empty if the rig does not run in real time.
        num_missed: readings that were late by more than one interval.
        error: the exception behind `reason`, if any.
        rig, player: facts about the rig and the player, JSON-ready.
    """

    reason: str = COMPLETE
    trip: Trip = Trip.NONE
    num_samples: int = 0
    max_abs_output: np.ndarray = field(default_factory=lambda: np.zeros(0))
    late: list[float] = field(default_factory=list)
    num_missed: int = 0
    error: BaseException | None = None
    rig: Mapping[str, object] = field(default_factory=dict)
    player: Mapping[str, object] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """Whether the whole experiment was played."""
        return self.reason == COMPLETE

    @property
    def late_ms_percentiles(self) -> dict[str, float] | None:
        """Delay of the readings [ms], by percentile; None if the rig is not in real time.

        A reading before it is due has no delay.
        """
        if not self.late:
            return None
        late = np.percentile(np.maximum(self.late, 0.0) * 1000, _PERCENTILES)
        return dict(zip(map(str, _PERCENTILES), late, strict=True))

    def to_dict(self) -> dict[str, object]:
        """The outcome as JSON-ready data, as in a record's sidecar under `ended`."""
        return {
            "reason": self.reason,
            "trip": self.trip.name.lower(),
            "num_samples": self.num_samples,
            "max_abs_output": self.max_abs_output.tolist(),
            "late_ms_percentiles": self.late_ms_percentiles,
            "missed_deadlines": self.num_missed,
            "rig": self.rig,
            "player": self.player,
        }

    def failed(self, what: str, error: BaseException) -> None:
        """Adds an error that came after the experiment's end."""
        self.reason += f"; {what}: {_sentence(error)}"
        if self.error is None or isinstance(error, ENDS_OF_PROGRAM):
            self.error = error


class Stop:
    """A request to end the experiment.

    Attributes:
        reason: one sentence; empty without a request.
        has_begun: whether the experiment has begun; before, signals act as usual.
        is_ending: whether it ends already; a request then changes nothing.
        asked: all requests, also those that changed nothing.
    """

    def __init__(self, has_begun: bool = True) -> None:
        """No request."""
        self.reason, self.has_begun, self.is_ending = "", has_begun, False
        self.asked: list[str] = []
        self._since = 0.0

    def ask(self, reason: str) -> None:
        """Asks for the end: the first reason counts.

        Raises:
            KeyboardInterrupt: where rig or player did not react to a request for two seconds.
        """
        now = time.perf_counter()
        self.asked.append(reason)
        if not self.reason:
            self.reason, self._since = reason, now
        elif not self.is_ending and now - self._since > _PATIENCE:
            raise KeyboardInterrupt


@contextlib.contextmanager
def interruptible(has_begun: bool = True) -> Iterator[Stop]:
    """A signal (Ctrl-C, a closed terminal) ends the experiment at its next reading.

    More signals change nothing, unless the rig or the player hangs. A handler that is set
    within stays. Outside the main thread, signals are not handled.

    Args:
        has_begun: False where the experiment sets `Stop.has_begun` when it begins.
    """
    stop, before = Stop(has_begun), {}
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if stop.has_begun:
            stop.ask(f"interrupted by {signal.Signals(number).name}")
        elif callable(usual := before[number]):
            usual(number, frame)
        elif usual == signal.SIG_DFL:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)

    for name in SIGNALS:
        if (number := getattr(signal, name, None)) is not None:
            before[number] = signal.getsignal(number)
            signal.signal(number, ask)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is ask:
                signal.signal(number, handler)


def ignore_signals() -> None:
    """For the end of a program: a request to end it changes nothing, not even its exit code."""
    for name in SIGNALS:
        if (number := getattr(signal, name, None)) is not None:
            signal.signal(number, signal.SIG_IGN)


@dataclass
class _Run:
    """An experiment from its first reading on."""

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
        """Takes the first reading."""
        if not 0 <= rig.num_latency < rig.num_readings:
            raise RigError(
                f"the rig's latency of {rig.num_latency} readings must be less than the "
                f"{rig.num_readings} of one sampling time"
            )
        first, now = rig.read(), time.perf_counter()
        rig.alive()
        watch = Watch.start(np, rules, first.outputs)
        run = cls(rig, rules, outcome, stop, watch, first, first, now, num_steps)
        run.look(first)
        return run

    @property
    def is_over(self) -> bool:
        """Whether a trip or a signal has ended it."""
        return bool(self.watch.trip != Trip.NONE or self.stop.reason)

    @property
    def time(self) -> float:
        """Time of the last reading since the first [s]."""
        return self.last.time - self.first.time

    def look(self, reading: Reading) -> None:
        """Checks a reading, and the time at which it came."""
        expected = self.rules.critical.shape
        if np.shape(reading.outputs) != expected:
            raise RigError(
                f"a reading of this plant has {expected[0]} outputs: got an array of shape "
                f"{np.shape(reading.outputs)}"
            )
        elapsed = reading.time - self.last.time
        self.watch = check_reading(np, self.rules, self.watch, reading.outputs, elapsed)
        self.last = reading
        if self.num_readings and not elapsed > 0:  # the same reading again
            self.trip(Trip.STALE)
        size = np.nan_to_num(np.abs(reading.outputs), posinf=0.0)
        self.outcome.max_abs_output = np.maximum(self.outcome.max_abs_output, size)
        if self.rig.is_real_time:
            self._look_at_clock()
        self.num_readings += 1

    def lateness(self) -> float:
        """Time since the next reading was due [s]."""
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
        # A reading late by dt, or consecutive late readings for more than dt.
        if late > self.rules.dt or self.num_late > max(self.rig.num_readings, 2):
            self.trip(Trip.DEADLINES)

    def look_at_player(self) -> None:
        """Trips where the player took so long that its input is too late."""
        if self.rig.is_real_time and self.lateness() > self.rules.dt:
            self.trip(Trip.DEADLINES)

    def record(
        self,
        recorder: Recorder,
        on_sample: Callable[[Sample], None],
        k: int,
        input: np.ndarray,
    ) -> None:
        """Records the sample whose input takes effect now, unless its reading is invalid."""
        if recorder.num_samples == k and self.watch.trip not in _FALSE_MEASUREMENTS:
            recorder.append(input, self.last.outputs, self.last.time)
            if k < self.num_steps:
                on_sample(self._sample(k, input))

    def _sample(self, k: int, input: np.ndarray) -> Sample:
        description = self.rig.description
        return Sample(description, self.num_steps, k, self.time, self.last.outputs, input)

    def trip(self, trip: Trip) -> None:
        """Ends the experiment for a reason other than the outputs."""
        self.watch = tripped(np, self.watch, np.True_, trip)

    def ended(self) -> None:
        """Writes the reason for an early end into the outcome."""
        self.outcome.trip = Trip(int(self.watch.trip))
        if self.outcome.trip != Trip.NONE:
            shown = ", ".join(map(_shown, self.rig.description.outputs, self.last.outputs))
            self.outcome.reason = f"{self.outcome.trip.sentence} ({shown} at {self.time:.2f} s)"
        elif self.stop.reason:
            self.outcome.reason = self.stop.reason


def _shown(output: Output, value: float) -> str:
    unit, factor = display_unit(output.unit)
    return f"{output.name} {factor * value:.4g} {unit}"


def run_loop(
    rig: AbstractRig,
    player: AbstractPlayer,
    rules: Supervision,
    recorder: Recorder,
    *,
    stop: Stop | None = None,
    on_sample: Callable[[Sample], None] = lambda _: None,
) -> Outcome:
    """One experiment on an open rig, from its first reading to the safe input.

    An experiment that ends early raises nothing; the outcome has the reason.

    Args:
        rig: open.
        player: proposes the inputs.
        rules: of the supervisor.
        recorder: open; it writes to the sidecar how the experiment ended.
        stop: a request to end.
        on_sample: called at every sampling instant, after the input was applied.

    Raises:
        ValueError, OSError: where the record cannot be begun; nothing was played.
    """
    recorder.begin()
    outcome = Outcome(max_abs_output=np.zeros(len(rules.critical)))
    stop = stop or Stop()
    try:
        under_way = _Run.begin(rig, rules, outcome, stop, player.num_steps)
        _play(under_way, player, recorder, on_sample)
        under_way.ended()
    except BaseException as error:  # also of who ends the program
        outcome.reason, outcome.error = _sentence(error), error
    stop.is_ending = True
    try:
        rig.make_safe()
    except BaseException as error:
        outcome.failed("the safe input could not be applied", error)
    outcome.rig, outcome.player = _facts(rig), _facts(player)
    try:
        recorder.end(outcome.to_dict())
    except BaseException as error:  # a full disk, for example
        outcome.failed("the end was not recorded", error)
    return outcome


def _facts(part: AbstractRig | AbstractPlayer) -> Mapping[str, object]:
    """The facts, or the error in calling for them, so that the end is recorded in any case."""
    try:
        return json.loads(json_text(part.facts()))
    except BaseException as error:
        return {"error": _sentence(error)}


def _play(
    run: _Run,
    player: AbstractPlayer,
    recorder: Recorder,
    on_sample: Callable[[Sample], None],
) -> None:
    """Plays the sampling instants, and takes the measurement at the end."""
    rig, latency = run.rig, run.rig.num_latency
    for k in itertools.count():
        run.watch = check_sample(np, run.rules, run.watch)
        is_last = k >= player.num_steps and player.is_at_rest
        proposed = rig.safe_input if is_last or run.is_over else player(k, run.last.outputs)
        run.look_at_player()
        if player.is_over:
            run.trip(Trip.UNEXPLAINED)
        run.watch, input = allowed(np, run.rules, run.watch, proposed)
        rig.alive()
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
                rig.alive()
        planned = (k + 1) * run.rules.dt
        if abs(run.time - planned) > 0.02 * planned + 2 * run.rules.dt:
            run.trip(Trip.DURATION)


def _sentence(error: BaseException) -> str:
    """An error as a sentence; with its type, unless the message is meant for users."""
    if isinstance(error, RigError | OSError):
        return str(error)
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    return f"{type(error).__name__}: {error}".removesuffix(": ")
