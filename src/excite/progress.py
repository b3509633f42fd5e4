"""How far a long computation is, as a line: what it does, how much is done, the time left."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[str, float, float], None]
"""Called with a text, how much is done (NaN: it is not known), and the total."""


def seconds_between() -> float:
    """Between two lines [s]: EXCITE_PROGRESS, or ten; 0 means none."""
    text = os.environ.get("EXCITE_PROGRESS") or "10"
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds < 1e6:
        raise ValueError(f"EXCITE_PROGRESS must be a number of seconds from 0 to 1e6: got {text!r}")
    return seconds


class Course:
    """What a computation does, and how fast."""

    def __init__(self, what: str = "") -> None:
        """`what` the computation is for."""
        self._what, self._text = what, ""
        self._began = time.monotonic()
        self._share = math.nan
        # Time and share when it first grew: what came before is work done earlier, and start-up.
        self._first: tuple[float, float] | None = None

    def update(self, text: str, done: float, total: float) -> None:
        """Sets the current step, how much is done (NaN: it is not known), and the total."""
        share = done / total if total else 0.0
        if share > self._share:
            self._first = self._first or (time.monotonic(), share)
        elif share != self._share:  # what is resumed may begin before what was told first
            self._first = None
        self._text, self._share = text, share

    def line(self) -> str:
        """The current step, how much of it is done, and the time left or elapsed."""
        now, share = time.monotonic(), self._share
        since, before = self._first or (now, share)
        if share > before:
            how_long = f"{_duration((now - since) * (1 - share) / (share - before))} left"
        else:
            how_long = f"{_duration(now - self._began)} so far"
        words = f"{100 * share:.0f} %, {how_long}" if share > 0 else how_long
        return ", ".join(filter(None, (": ".join(filter(None, (self._what, self._text))), words)))


class _Shown:
    """Prints a line on stderr every ten seconds while a function of the library works."""

    def __init__(self) -> None:
        self._course, self._total, self._last = Course(), math.nan, 0.0

    def __call__(self, text: str, done: float, total: float) -> None:
        now = time.monotonic()
        if not done or total != self._total:  # another computation
            self._course, self._total, self._last = Course(), total, now
        self._course.update(text, done, total)
        if 0 < seconds_between() <= now - self._last:
            sys.stderr.write(f"{self._course.line()}\n")
            self._last = now

    def __repr__(self) -> str:
        return "a line on stderr every ten seconds"


SHOWN: Progress = _Shown()
"""What the functions of `excite` do by default; `EXCITE_PROGRESS=0` in the environment for none."""


def _duration(seconds: float) -> str:
    """A duration in hours, minutes or seconds."""
    hours, minutes = divmod(round(seconds / 60), 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min" if seconds >= 90 else f"{seconds:.0f} s"
