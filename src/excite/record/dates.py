"""Dates and times of day as seconds."""

from __future__ import annotations

import re
import warnings
from typing import Any

import numpy as np

from .table import require_pandas

DATE = re.compile(r"\d{1,4}([-./])\d{1,2}\1\d{1,4}\b.*")
_TIME_OF_DAY = re.compile(r"(\d+ days? )?\d{1,2}:\d\d:\d\d\b.*")


def seconds_of(dates: np.ndarray) -> np.ndarray:
    """Seconds since the first of the dates or times of day, NaN for what is neither.

    01/02/2026 is read month first or day first: the way that understands more of the dates, or
    if both understand as many, the one that gives the shorter record.
    """
    pandas = require_pandas("dates as time")
    cells = pandas.Index(dates)
    if dates.dtype.kind == "O" and _TIME_OF_DAY.fullmatch(str(dates[0])):
        return _since_first(pandas.to_timedelta(cells, errors="coerce"))
    ways = ({"format": "ISO8601"}, {"dayfirst": False}, {"dayfirst": True})
    with warnings.catch_warnings(action="ignore"):  # about the ways that do not fit
        read = [pandas.to_datetime(cells, utc=True, errors="coerce", **way) for way in ways]
    return max(map(_since_first, read), key=_fitness)


def _since_first(stamps: Any) -> np.ndarray:
    return (stamps - stamps[0]).total_seconds().to_numpy()


def _fitness(seconds: np.ndarray) -> tuple[int, float]:
    """How many dates were understood, and how short the record is."""
    known = seconds[np.isfinite(seconds)]
    return known.size, -np.ptp(known) if known.size else 0.0
