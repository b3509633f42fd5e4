"""The Quanser Aero 2, yaw locked: its pitch, over Quanser's HIL interface; NumPy alone.

The interface comes with Quanser's SDK; only this module needs it. The card's
clock sets the pace: a task on the card reads the encoder at 500 Hz, and `read` waits for its
next sample. The card's watchdog stops the motors even if this process is killed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from time import sleep
from typing import Any

import numpy as np

from ..description import PlantDescription
from .contract import AbstractRig, Reading, RigError

try:
    from quanser import hardware  # pyright: ignore[reportMissingImports]
    from quanser.hardware.enumerations import (  # pyright: ignore[reportMissingImports]
        BufferOverflowMode,
    )
except ImportError:
    hardware: Any = None
    BufferOverflowMode: Any = None

CARD = "quanser_aero2_usb"
"""HIL's name of the Aero 2."""

MAX_VOLTAGE = 24.0
"""Maximum motor voltage [V]."""

READING_RATE = 500.0
"""Readings per second [Hz]."""

COUNTS = 2880
"""Counts of the pitch encoder in one revolution."""

WATCHDOG_TIMEOUT = 0.5
"""The card stops the motors after this time without a reading [s].

The loop ends itself when it is late by one sampling time, 0.1 s. The watchdog is for a
process that was killed or hangs. In this time full voltage moves a body at rest by 0.075 rad.
"""

REST_SECONDS = 0.5
"""Time for which the body must not move when the rig is opened [s]."""

_REST_READINGS = 10
_MOTORS = np.array([0, 1], np.uint32)  # analog outputs, and digital ones of their amplifiers
_ENCODERS = np.array([0, 1, 2, 3], np.uint32)  # rotors, pitch, yaw
_PITCH = np.array([2], np.uint32)
_WITHOUT_END = 2**32 - 1  # number of samples of a task that runs until it is stopped


class QuanserAero2(AbstractRig):
    """An Aero 2, or its virtual twin: u on the first motor, -u on the second.

    The body must be level and at rest when the rig is opened: this pitch becomes zero. The
    sensor in the description is the encoder, whatever the plant's sensor.
    """

    starts_at_rest = True

    def __init__(self, description: PlantDescription, address: str = "0") -> None:
        """A rig that is not open yet.

        Args:
            description: of one of the plants `aero2`, `aero2_lag`, `aero2_detailed`, or like it.
            address: HIL's board identifier: "0", or "0@tcpip://localhost:18950" (virtual).

        Raises:
            ValueError: for a plant that is not an Aero 2, or a dt that is not a multiple of 2 ms.
        """
        largest = max(max(-i.lower, i.upper) for i in description.inputs)
        if (len(description.inputs), len(description.outputs)) != (1, 1) or largest > MAX_VOLTAGE:
            raise ValueError(
                f"{description.name}: the Aero 2 has one input of at most {MAX_VOLTAGE:g} V "
                "and one output, its pitch"
            )
        readings = description.dt * READING_RATE
        self.num_readings = round(readings)
        if self.num_readings < 1 or not math.isclose(readings, self.num_readings):
            raise ValueError(
                f"dt must be a multiple of {1 / READING_RATE:g} s, the time between two readings "
                f"of the Aero 2: got {description.dt:g} s"
            )
        self.description, self._address = _with_encoder(description), address
        self._is_virtual = "@" in address
        self._card: object = None
        self._task: object = None
        self._num_read = 0
        self._held: set[str] = set()  # calls that did not fail, for `close`
        self._counts = np.zeros(1, np.int32)

    def open(self) -> None:
        """Opens the card, sets encoders and motors to zero, and enables the amplifiers."""
        if hardware is None:
            raise RigError(
                "Quanser's Python package `quanser` is missing: it comes with Quanser's SDK, "
                "not from a package index"
            )
        self._num_read = 0
        self._card = hardware.HIL()
        self._call("open", CARD, self._address)
        # A card whose watchdog expired accepts nothing before this call. A card with nothing to
        # clear may return an error; one that still accepts nothing fails at the next call.
        with contextlib.suppress(RigError):
            self._call("watchdog_clear")
        self._apply(0.0)
        self._call("set_encoder_counts", _ENCODERS, len(_ENCODERS), np.zeros(4, np.int32))
        self._require_rest()
        room = int(READING_RATE)
        self._task = self._call("task_create_encoder_reader", room, _PITCH, len(_PITCH))
        # Lost samples are not fetched; the loop detects that it is late.
        modes = BufferOverflowMode
        mode = modes.WAIT_ON_OVERFLOW if self._is_virtual else modes.OVERWRITE_ON_OVERFLOW
        self._call("task_set_buffer_overflow_mode", self._task, mode)
        self._enable(True)

    def read(self) -> Reading:
        """The pitch, when the card has sampled it; its clock starts with the first reading."""
        if "task_start" not in self._held:
            self._start()
        if self._call("task_read_encoder", self._task, 1, self._counts) != 1:
            raise RigError("task_read_encoder of the Aero 2 gave no sample: its task has ended")
        if not self._call("watchdog_reload"):
            raise RigError(
                f"the watchdog of the Aero 2 stopped the motors: no reading for "
                f"{WATCHDOG_TIMEOUT:g} s"
            )
        now = self._num_read / READING_RATE
        self._num_read += 1
        return Reading(now, self._counts * (2 * math.pi / COUNTS))

    def write(self, input: np.ndarray) -> None:
        """Applies one voltage to both motors, with opposite signs."""
        (voltage,) = np.asarray(input, float).tolist()
        limits = self.description.inputs[0]
        if not limits.lower <= voltage <= limits.upper:  # nor is NaN
            raise RigError(
                f"an input of the Aero 2 must be from {limits.lower:g} to {limits.upper:g} V: "
                f"got {voltage:g}"
            )
        if voltage != 0 and "task_start" not in self._held:
            raise RigError("the Aero 2 must be read before it is driven: that starts its watchdog")
        self._apply(voltage)

    def close(self) -> None:
        """Stops the motors and releases the card, each step even after one that failed."""
        steps = (
            ("open", lambda: self._apply(0.0)),
            ("open", lambda: self._enable(False)),
            ("watchdog_start", lambda: self._call("watchdog_stop")),
            ("task_start", lambda: self._call("task_stop", self._task)),
            ("task_create_encoder_reader", lambda: self._call("task_delete", self._task)),
            ("open", lambda: self._call("close")),
        )
        errors = []
        for i, (needed, step) in enumerate(steps):
            # If neither zero nor disabling succeeded, only the watchdog can stop the motors.
            if i == 2 and len(errors) == 2:
                continue
            try:
                if needed in self._held:
                    step()
            except BaseException as error:  # Ctrl-C must not leave the motors running either
                errors.append(error)
        self._held.clear()
        if errors:
            raise errors[0]

    def facts(self) -> Mapping[str, object]:
        """Card and address, and how it is read."""
        return {
            "kind": "quanser",
            "card": CARD,
            "address": self._address,
            "reading_rate": READING_RATE,
            "watchdog_timeout": WATCHDOG_TIMEOUT,
        }

    def _require_rest(self) -> None:
        """Raises RigError if the body still moves: its zero would be an arbitrary angle."""
        seen = []
        for _ in range(_REST_READINGS):
            self._call("read_encoder", _PITCH, len(_PITCH), self._counts)
            seen.append(int(self._counts[0]))
            sleep(REST_SECONDS / _REST_READINGS)
        if (moved := max(seen) - min(seen)) > 1:
            raise RigError(
                f"the body of the Aero 2 is not at rest: it moved by {moved} counts of its encoder "
                f"in {REST_SECONDS:g} s; hold it still, or wait"
            )

    def _start(self) -> None:
        # Not in `open`: samples taken before the first reading would be read in a burst, and
        # the watchdog would expire while the user prepares the experiment.
        self._call("watchdog_set_analog_expiration_state", _MOTORS, len(_MOTORS), np.zeros(2))
        self._call("watchdog_start", WATCHDOG_TIMEOUT)
        clock = hardware.Clock.HARDWARE_CLOCK_0
        self._call("task_start", self._task, clock, READING_RATE, _WITHOUT_END)

    def _apply(self, voltage: float) -> None:
        self._call("write_analog", _MOTORS, len(_MOTORS), np.array([voltage, -voltage]))

    def _enable(self, on: bool) -> None:
        self._call("write_digital", _MOTORS, len(_MOTORS), np.full(2, on, np.int8))

    def _call(self, name: str, *arguments: object) -> object:
        self._held.add(name)  # before: an interrupt may come after the card has done it
        try:
            return getattr(self._card, name)(*arguments)
        except hardware.HILError as error:
            self._held.discard(name)
            why = error.get_error_message()
            raise RigError(f"{name} of the Aero 2 failed: {why}") from error


def _with_encoder(description: PlantDescription) -> PlantDescription:
    """The description with the encoder's resolution, which the supervisor needs."""
    (pitch,) = description.outputs
    pitch = dataclasses.replace(pitch, resolution=max(pitch.resolution, 2 * math.pi / COUNTS))
    return dataclasses.replace(description, outputs=(pitch,))
