"""What a rig is, what plays on it, and the record that grows with it; NumPy alone.

A rig is opened, read, written and closed. `read` returns when the next reading is due, so
that a rig with a clock of its own paces the loop; one without has a `Pacer`. A rig is a
context manager that ends with the safe input and released hardware, whatever happens in
between; a new rig is one class with those four methods.

Every sample is on disk before the next. The sidecar of a record is written before its
first sample, without an end, and again at the end; a process that is killed leaves a
record of all samples so far that can be read like any other.
"""

from __future__ import annotations

import abc
import contextlib
import time
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np

from ..description import PlantDescription
from ..safety import safe_input


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


@dataclass(frozen=True)
class Sample:
    """What a live view and a live estimate see of one sampling instant.

    Attributes:
        k: its index.
        time: since the first [s].
        measured: outputs.
        input: held until the next.
    """

    k: int
    time: float
    measured: np.ndarray
    input: np.ndarray


class AbstractRig(abc.ABC):
    """A plant that can be excited: hardware, or what behaves like it.

    Attributes:
        description: of the plant: units, limits, levels, sampling time.
        num_readings: readings in one sampling time, at least 1; the supervisor looks at each.
        num_latency: readings from a write to its action, less than `num_readings`. A record
            holds the reading at the action, so that its inputs change when it says.
        is_real_time: whether its time is that of the wall.
        starts_at_rest: whether the plant is at its initial state when the rig is open.
    """

    description: PlantDescription
    num_readings: int = 1
    num_latency: int = 0
    is_real_time: bool = True
    starts_at_rest: bool = False

    @abc.abstractmethod
    def open(self) -> None:
        """Takes the hardware and makes it ready, its input zero.

        Raises:
            RigError: where that is not possible.
        """

    @abc.abstractmethod
    def read(self) -> Reading:
        """The next reading, when it is due: one every dt / num_readings."""

    @abc.abstractmethod
    def write(self, input: np.ndarray) -> None:
        """Applies an input, in the plant's units, until the next."""

    @abc.abstractmethod
    def close(self) -> None:
        """Releases the hardware; called once after `open`, also one that failed half way."""

    @property
    def safe_input(self) -> np.ndarray:
        """What is applied when an experiment ends: zero, or the limit nearest to it."""
        return safe_input(self.description)

    def facts(self) -> dict[str, Any]:
        """What a record should say of the rig, JSON-ready; after the end of an experiment."""
        return {}

    def __enter__(self) -> Self:
        """Opens the rig; one that fails to open is closed."""
        try:
            self.open()
        except BaseException:
            with contextlib.suppress(Exception):
                self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Ends with the safe input and releases the hardware, the second even without the first."""
        try:
            self.write(self.safe_input)
        finally:
            self.close()


class Pacer:
    """Waits for instants that lie one interval apart, by the monotonic clock."""

    def __init__(self, interval: float) -> None:
        """`interval` in seconds."""
        self.interval = interval
        self._start = time.perf_counter()
        self._count = -1

    def wait(self) -> float:
        """Returns at the next instant, or at once where it is over; the time since the first."""
        self._count += 1
        if self._count == 0:
            self._start = time.perf_counter()
        due = self._count * self.interval
        while (left := self._start + due - time.perf_counter()) > 0:
            # A sleep ends late by up to a tenth of a millisecond: the last part is waited awake.
            time.sleep(left - 2e-4 if left > 4e-4 else 0)
        return time.perf_counter() - self._start
