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
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from ..description import PlantDescription
from ..files import json_text, write_bytes
from ..policy import (
    Policy,
    empty_window,
    network,
    observe,
    scaled_action,
    with_input,
    with_measurement,
)
from ..records import RECORD_KIND, require_record_path
from ..safety import safe_input

_RESERVE = 16_384  # spaces in a sidecar, in whose place its end is written on a full disk


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


class AbstractPlayer(abc.ABC):
    """What proposes the inputs of an experiment.

    Attributes:
        num_steps: for how many sampling instants.
    """

    num_steps: int

    @abc.abstractmethod
    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """The input proposed at sampling instant k."""

    def applied(self, input: np.ndarray) -> None:
        """Called with the input that was applied in its place."""
        del input

    def origin(self) -> dict[str, Any]:
        """Where its inputs come from, JSON-ready; before the experiment."""
        return {}

    def facts(self) -> dict[str, Any]:
        """What a record should say of it, JSON-ready; after the end of an experiment."""
        return {}


class SignalPlayer(AbstractPlayer):
    """A signal known beforehand."""

    def __init__(self, inputs: np.ndarray) -> None:
        """`inputs` by time and input, in the plant's units."""
        self._inputs, self.num_steps = np.asarray(inputs, float), len(inputs)

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """Row k."""
        del measured
        return self._inputs[k]


class PolicyPlayer(AbstractPlayer):
    """A learned policy, as in training but for the inputs in its window: those applied."""

    def __init__(self, policy: Policy) -> None:
        """A policy before its experiment."""
        self._policy, self._layout = policy, policy.layout
        self._window = empty_window(np, policy.layout)
        self.num_steps = policy.layout.num_steps

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """The network's input for the window that ends with this measurement."""
        self._window = with_measurement(np, self._layout, self._window, measured)
        observation = observe(np, self._layout, self._window, k)
        with np.errstate(over="ignore", invalid="ignore"):
            action = network(np, self._policy.weights, observation).astype(float)
        # Not zero, as in training: for what is no number the supervisor ends the experiment.
        action = np.where(np.isfinite(action), np.clip(action, -1.0, 1.0), np.nan)
        return scaled_action(np, self._layout, action)

    def applied(self, input: np.ndarray) -> None:
        """The window remembers what was applied."""
        self._window = with_input(np, self._layout, self._window, input)

    def origin(self) -> dict[str, Any]:
        """The policy's hash."""
        return {"policy_hash": self._policy.hash}


def step_seconds(make: Callable[[], AbstractPlayer], num_outputs: int) -> float:
    """99th percentile of the time that one step of a player takes, of 200 dry ones [s]."""
    player, took = make(), []
    for k in range(min(200, player.num_steps)):
        start = time.perf_counter()
        player.applied(player(k, np.zeros(num_outputs)))
        took.append(time.perf_counter() - start)
    return float(np.percentile(took, 99))


class Recorder:
    """Appends to a CSV record; a context manager."""

    def __init__(
        self,
        path: Path,
        description: PlantDescription,
        metadata: Mapping[str, Any],
        overwrite: bool = False,
    ) -> None:
        """A record at `path`, which ends in .csv.

        Args:
            metadata: for the sidecar: policy hash, limits, versions.

        Raises:
            ValueError: where it may not be written.
        """
        require_record_path(path, overwrite)
        if path.suffix.lower() != ".csv":
            raise ValueError(f"{path}: an experiment is recorded as .csv, line by line")
        if "clock" in description.columns:
            raise ValueError("no input or output may be called 'clock': a record has its own")
        self._path, self._description = path, description
        self._metadata = {
            "plant": description.to_dict(),
            "plant_hash": description.hash,
            "starts_at_initial_state": False,
            **metadata,
            "kind": RECORD_KIND,
            "dt": description.dt,
        }
        self.num_samples = 0

    def __enter__(self) -> Self:
        """Writes the sidecar and the header; what was there before stays where one cannot."""
        # A line is one call, whole or not at all.
        self._file = self._path.open("ab", buffering=0)
        try:
            self._write_sidecar({"ended": None}, _RESERVE)
            self._file.truncate(0)
            self._line([*self._description.columns, "clock"])
        except BaseException:
            self._file.close()
            raise
        return self

    def append(self, inputs: np.ndarray, outputs: np.ndarray, clock: float) -> None:
        """One more sample: outputs measured at it and inputs held from it.

        Args:
            clock: the rig's time [s]; the column `time` has the nominal one.
        """
        nominal = self.num_samples * self._description.dt
        numbers = (nominal, *np.asarray(inputs).tolist(), *np.asarray(outputs).tolist(), clock)
        self._line([repr(float(x)) for x in numbers])
        self.num_samples += 1

    def end(self, ended: Mapping[str, Any]) -> None:
        """Says in the sidecar how the experiment ended, on a full disk as well."""
        try:
            self._write_sidecar({"ended": dict(ended)})
        except ValueError:
            text = json_text({**self._metadata, "ended": dict(ended)}).encode()
            with self._path.with_suffix(".json").open("r+b") as file:
                if len(text) > file.seek(0, os.SEEK_END):
                    raise
                file.seek(0)
                file.write(text)
                file.truncate()

    def __exit__(self, *_: object) -> None:
        """Closes the file."""
        self._file.close()

    def _line(self, words: list[str]) -> None:
        line, before = (",".join(words) + "\n").encode(), self._file.tell()
        if self._file.write(line) != len(line):
            self._file.truncate(before)  # half a line would spoil all others
            raise OSError(f"{self._path}: the disk is full")

    def _write_sidecar(self, more: Mapping[str, Any], reserve: int = 0) -> None:
        text = json_text({**self._metadata, **more}) + " " * reserve + "\n"
        write_bytes(self._path.with_suffix(".json"), text.encode())
