"""A strict stand-in for Quanser's HIL interface with an Aero 2 behind it; NumPy alone.

What the interface does not allow raises `MisuseError` and is remembered; what can go wrong on a
good day raises `HILError`. The device outlives its handles, as the hardware does. With
`tests/standin` on PYTHONPATH it is the package `quanser.hardware`, in real time.

STANDIN_LOG names a file to which every call is written before it is answered.
"""

import json
import math
import os
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from .enumerations import BufferOverflowMode as BufferOverflowMode
from .enumerations import Clock as Clock

RATE = 500.0
COUNTS = 2880
MODES = BufferOverflowMode


class MisuseError(AssertionError):
    """A call that the interface does not allow."""


class HILError(Exception):
    def __init__(self, error_code):
        self.error_code = error_code

    def get_error_message(self, locale=None, buffer_size=-1):
        return f"error {self.error_code}"


class Device:
    """The Aero 2 and its card: body, motors, encoder, task, watchdog.

    Args:
        real_time: whether a second is one of the wall; else a reading comes at once.
        log: file for every call.
    """

    def __init__(self, real_time=False, log=None):
        self.real_time, self.log = real_time, log
        self.calls, self.misuses, self.resources = [], [], set()
        self.failing: Callable[[int, str], bool] = lambda *_: False
        self.is_watchdog_clearable = True
        self.voltages, self.enabled = np.zeros(2), np.zeros(2, np.int8)
        self.expiration: np.ndarray | None = None  # a card without one keeps its voltages
        self.timeout, self.reloaded = math.inf, 0.0
        self.fired_at: float | None = None
        self.pitch, self.rate, self.offsets = 0.0, 0.0, np.zeros(4, np.int64)
        self.is_held = False  # by hand
        self.mode, self.room, self.samples, self.num_lost = 0, 0, deque(), 0
        self._num_ticks, self._simulated, self._start = 0, 0.0, time.perf_counter()

    @property
    def now(self):
        return time.perf_counter() - self._start if self.real_time else self._simulated

    def wait(self, seconds):
        """Time goes by, without anybody at the card."""
        if self.real_time:
            time.sleep(max(seconds, 0.0))
        else:
            self._simulated += max(seconds, 0.0)
        self.advance()

    def abandon(self):
        """The process that had the card open is gone; its operating system cleans up."""
        self.resources -= {"open", "task_start", "task_create"}

    def advance(self):
        """Ticks until now."""
        while (self._num_ticks + 1) / RATE <= self.now + 1e-9:
            is_full = "task_start" in self.resources and len(self.samples) == self.room
            if is_full and self.mode == MODES.WAIT_ON_OVERFLOW:
                # A virtual device stands still meanwhile.
                lost = math.floor((self.now + 1e-9) * RATE) - self._num_ticks
                self._start += lost / RATE
                self._simulated -= lost / RATE
                return
            self._num_ticks += 1
            self._tick(self._num_ticks / RATE)

    def _tick(self, now):
        if self.fired_at is None and now > self.reloaded + self.timeout:
            self.fired_at = now
            if self.expiration is not None:
                self.voltages = self.expiration.copy()
        first, second = self.voltages * self.enabled
        u = (first - second) / 2
        acceleration = 2 * 0.0125 * u - 0.045 * self.rate - 0.88 * math.sin(self.pitch)
        self.rate = 0.0 if self.is_held else self.rate + acceleration / RATE
        self.pitch += self.rate / RATE
        if "task_start" in self.resources:
            if len(self.samples) == self.room:
                self.num_lost += 1
                if self.mode == MODES.OVERWRITE_ON_OVERFLOW:
                    self.samples.popleft()
                else:
                    return
            self.samples.append(self.counts[2])

    @property
    def counts(self):
        turns = np.array([0.0, 0.0, self.pitch / (2 * math.pi), 0.0])
        return np.round(turns * COUNTS).astype(np.int64) + self.offsets

    def called(self, name, **arguments):
        """Every call begins here: it is remembered, time goes by, it may fail."""
        index = len(self.calls)
        self.calls.append((name, arguments))
        if self.log:
            with open(self.log, "a") as file:
                file.write(json.dumps([time.monotonic(), name, arguments], default=repr) + "\n")
        self.advance()
        if self.failing(index, name):
            raise HILError(f"-1 at call {index}")

    def require(self, condition, sentence):
        if not condition:
            self.misuses.append(sentence)
            raise MisuseError(sentence)


device = Device(real_time=True, log=os.environ.get("STANDIN_LOG"))


class Task:
    """A handle."""


class HIL:
    """The calls of Quanser's class that an Aero 2 needs, with their order of arguments."""

    def __init__(self, card_type=None, card_identifier=None):
        self._device, self._is_open, self._task = device, False, None
        if card_type is not None:
            self.open(card_type, card_identifier)

    def open(self, card_type, card_identifier):
        d = self._device
        d.called("open", card=card_type, identifier=card_identifier)
        d.require(card_type == "quanser_aero2_usb", f"no card {card_type}")
        virtual = card_identifier.startswith("0@tcpip://")
        d.require(virtual or card_identifier == "0", f"no device {card_identifier}")
        d.require("open" not in d.resources, "opened twice")
        self._is_open, self._is_virtual = True, virtual
        d.resources.add("open")

    def is_valid(self):
        return self._is_open

    def close(self):
        self._call("close")
        self._device.resources -= {"open", "task_start", "task_create"}
        self._is_open = False

    def set_encoder_counts(self, channels, num_channels, counts):
        self._call("set_encoder_counts", counts=counts.tolist())
        self._check(channels, num_channels, range(4), counts, np.int32)
        d = self._device
        d.offsets[channels] += counts - d.counts[channels]

    def read_encoder(self, channels, num_channels, buffer):
        self._call("read_encoder")
        self._check(channels, num_channels, range(4), buffer, np.int32)
        buffer[:] = self._device.counts[channels]

    def write_analog(self, channels, num_channels, buffer):
        self._call("write_analog", volts=buffer.tolist())
        self._check(channels, num_channels, range(2), buffer, np.float64)
        self._device.require(bool((np.abs(buffer) <= 24).all()), f"volts {buffer}")
        self._refuse_expired()
        self._device.voltages[channels] = buffer

    def write_digital(self, channels, num_channels, buffer):
        self._call("write_digital", bits=buffer.tolist())
        self._check(channels, num_channels, range(2), buffer, np.int8)
        self._device.require(set(buffer.tolist()) <= {0, 1}, f"bits {buffer}")
        self._refuse_expired()
        self._device.enabled[channels] = buffer

    def task_create_encoder_reader(self, samples_in_buffer, channels, num_channels):
        self._call("task_create_encoder_reader", samples=samples_in_buffer)
        self._check(channels, num_channels, range(4), None, None)
        d = self._device
        d.require(self._task is None, "a second task")
        d.require(channels.tolist() == [2], f"encoders {channels}, of which only 2 moves")
        d.require(isinstance(samples_in_buffer, int) and samples_in_buffer > 0, "buffer size")
        d.room, d.mode, self._task = samples_in_buffer, MODES.ERROR_ON_OVERFLOW, Task()
        d.samples.clear()
        d.resources.add("task_create")
        return self._task

    def task_set_buffer_overflow_mode(self, task, mode):
        self._call("task_set_buffer_overflow_mode", mode=mode)
        self._check_task(task, running=False)
        waits = mode == MODES.WAIT_ON_OVERFLOW
        self._device.require(not waits or self._is_virtual, "hardware does not wait")
        self._device.mode = mode

    def task_start(self, task, clock, frequency, num_samples):
        self._call("task_start", clock=clock, frequency=frequency, samples=num_samples)
        self._check_task(task, running=False)
        d = self._device
        d.require(clock == Clock.HARDWARE_CLOCK_0, f"clock {clock}")
        d.require(frequency == RATE, f"frequency {frequency}")
        d.require(0 < num_samples < 2**32, f"samples {num_samples}")
        d.resources.add("task_start")
        self._num_left = num_samples if num_samples < 2**32 - 1 else math.inf

    def task_read_encoder(self, task, num_samples, buffer):
        self._call("task_read_encoder")
        self._check_task(task, running=True)
        d = self._device
        d.require(num_samples == 1, "one sample at a time")
        d.require(buffer.dtype == np.int32 and buffer.shape == (1,), "buffer of counts")
        if d.num_lost and d.mode == MODES.ERROR_ON_OVERFLOW:
            raise HILError("-overflow")
        if self._num_left == 0:
            return 0
        while not d.samples:
            d.wait((d._num_ticks + 1) / RATE - d.now)
        buffer[0] = d.samples.popleft()
        self._num_left -= 1
        return 1

    def task_stop(self, task):
        self._call("task_stop")
        self._check_task(task, running=True)
        self._device.resources.remove("task_start")

    def task_delete(self, task):
        self._call("task_delete")
        self._check_task(task, running=None)
        self._device.resources -= {"task_create", "task_start"}
        self._task = None

    def watchdog_set_analog_expiration_state(self, channels, num_channels, voltages):
        self._call("watchdog_set_analog_expiration_state", volts=voltages.tolist())
        self._check(channels, num_channels, range(2), voltages, np.float64)
        d = self._device
        d.require("watchdog" not in d.resources, "set before the watchdog is started")
        d.require(channels.tolist() == [0, 1], "both motors")
        d.expiration = voltages.copy()

    def watchdog_start(self, timeout):
        self._call("watchdog_start", timeout=timeout)
        d = self._device
        d.require("watchdog" not in d.resources, "the watchdog runs already")
        d.require(timeout > 0, f"timeout {timeout}")
        d.timeout, d.reloaded = timeout, d.now
        d.resources.add("watchdog")

    def watchdog_reload(self):
        self._call("watchdog_reload")
        d = self._device
        d.require("watchdog" in d.resources, "the watchdog does not run")
        if d.fired_at is None:
            d.reloaded = d.now
        return d.fired_at is None

    def watchdog_stop(self):
        self._call("watchdog_stop")
        d = self._device
        d.require("watchdog" in d.resources, "the watchdog does not run")
        d.timeout = math.inf
        d.resources.remove("watchdog")

    def watchdog_clear(self):
        self._call("watchdog_clear")
        d = self._device
        if not d.is_watchdog_clearable:
            raise HILError("-clear")
        d.resources.discard("watchdog")
        d.timeout, d.fired_at = math.inf, None

    def _call(self, name, **arguments):
        self._device.require(self._is_open, f"{name} of a card that is not open")
        self._device.called(name, **arguments)

    def _check(self, channels, num_channels, allowed, values, dtype):
        require = self._device.require
        require(channels.dtype == np.uint32, f"channels of {channels.dtype}")
        require(num_channels == len(channels), f"{num_channels} of {len(channels)} channels")
        require(set(channels.tolist()) <= set(allowed), f"channels {channels}")
        if values is not None:
            require(values.dtype == dtype, f"values of {values.dtype}, not {dtype}")
            require(values.shape == channels.shape, f"{values.shape} values")

    def _check_task(self, task, running):
        d = self._device
        d.require(task is not None and task is self._task, "no such task")
        d.require(running in (None, "task_start" in d.resources), f"task running: {not running}")

    def _refuse_expired(self):
        if self._device.fired_at is not None:
            raise HILError("-watchdog expired")
