"""The contract of a rig, and the samples shown during an experiment; NumPy alone.

A rig is opened, read, written and closed. `read` returns when the next reading is due, so
that a rig with a clock sets the pace of the loop; one without a clock uses a `Pacer`. A rig
is a context manager that always ends with the safe input and released hardware. A new rig
is one class with those four methods.
"""

from __future__ import annotations

import abc
import contextlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import numpy as np

from ..description import PlantDescription
from ..safety import safe_input
from .watchdog import Watchdog, WatchdogProcess


class RigError(Exception):
    """A rig that failed; its text is one sentence."""


class Reading(NamedTuple):
    """One reading of a rig.

    Attributes:
        time: by the rig's clock [s].
        outputs: in the plant's units and order.
    """

    time: float
    outputs: np.ndarray


class Interval(NamedTuple):
    """An estimate and half the width of its 95 % confidence interval."""

    estimate: float
    ci95_half: float


def as_data(known: Mapping[str, Interval]) -> dict[str, dict[str, float]]:
    """Intervals by name, as JSON-ready data."""
    return {name: interval._asdict() for name, interval in known.items()}


@dataclass(frozen=True)
class Sample:
    """One sampling instant, for display while the experiment runs.

    Attributes:
        description: of the plant.
        num_steps: sampling instants of the whole experiment.
        k: index of this one.
        time: since the first [s].
        measured: outputs.
        input: held until the next.
        live_estimate: of the parameters by name, from the samples so far; empty at first.
    """

    description: PlantDescription
    num_steps: int
    k: int
    time: float
    measured: np.ndarray
    input: np.ndarray
    live_estimate: Mapping[str, Interval] = field(default_factory=dict)


class AbstractRig(abc.ABC):
    """A plant that can be excited: hardware or a simulation.

    Attributes:
        description: of the plant: units, limits, levels, sampling time.
        num_readings: readings in one sampling time, at least 1; the supervisor checks each.
        num_latency: readings between writing an input and its effect, less than
            `num_readings`. The record holds the reading at which the input takes effect.
        is_real_time: whether readings come in real time.
        starts_at_rest: whether the plant is at its initial state when the rig is opened.
        watchdog: how another process sends the safe input when this one was killed or hangs.
    """

    description: PlantDescription
    num_readings: int = 1
    num_latency: int = 0
    is_real_time: bool = True
    starts_at_rest: bool = False
    watchdog: Watchdog | None = None
    _watching: WatchdogProcess | None = None

    @abc.abstractmethod
    def open(self) -> None:
        """Connects to the hardware and prepares it, with zero input.

        Raises:
            RigError: if that is not possible.
        """

    @abc.abstractmethod
    def read(self) -> Reading:
        """The next reading, when it is due: one every dt / num_readings."""

    @abc.abstractmethod
    def write(self, input: np.ndarray) -> None:
        """Applies an input, in the plant's units, until the next one."""

    @abc.abstractmethod
    def close(self) -> None:
        """Releases the hardware; called once after `open`, even if that failed."""

    @property
    def safe_input(self) -> np.ndarray:
        """Input applied when an experiment ends: zero, or the nearest limit."""
        return safe_input(self.description)

    def facts(self) -> Mapping[str, Any]:
        """Facts about the rig for the record, JSON-ready; called after the experiment."""
        return {}

    def alive(self) -> None:
        """Tells the watchdog that the experiment is running; RigError if it has ended."""
        if self._watching is not None and (sentence := self._watching.beat()):
            raise RigError(sentence)

    def make_safe(self) -> None:
        """Applies the safe input, and tells the watchdog."""
        self.write(self.safe_input)
        if self._watching is not None:
            self._watching.rest()

    def __enter__(self) -> Self:
        """Starts the watchdog and opens the rig; closes it if that fails."""
        if self.watchdog is not None:
            interval = self.description.dt / self.num_readings
            self._watching = WatchdogProcess(self.watchdog, self.safe_input, interval)
        try:
            self.open()
        except BaseException:
            with contextlib.suppress(BaseException):
                self.close()
            self._end_watching(is_safe=True)  # no input was written
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Applies the safe input, and releases the hardware even if that fails."""
        is_safe = False
        try:
            self.make_safe()
            is_safe = True
        finally:
            try:
                self.close()
            finally:
                self._end_watching(is_safe)

    def _end_watching(self, is_safe: bool) -> None:
        watching, self._watching = self._watching, None
        if watching is not None:
            watching.end(is_safe)


class Pacer:
    """Waits for instants one interval apart, by the monotonic clock."""

    def __init__(self, interval: float) -> None:
        """`interval` in seconds."""
        self.interval = interval
        self._start = time.perf_counter()
        self._count = -1

    def wait(self) -> float:
        """Returns at the next instant, or at once if it has passed: time since the first [s]."""
        self._count += 1
        if self._count == 0:
            self._start = time.perf_counter()
        due = self._count * self.interval
        while (left := self._start + due - time.perf_counter()) > 0:
            # A sleep ends up to 0.1 ms late: the last part is a busy wait.
            time.sleep(left - 2e-4 if left > 4e-4 else 0)
        return time.perf_counter() - self._start
