"""Checks of a recorded experiment: sampling, finite numbers, units, limits."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from ..description import Input, Output, PlantDescription, names_of
from .record import Record

_UNEVEN = 0.05  # of the sampling time: more than rounding in the file explains
_MOST = 0.9  # of all steps are usual ones in an even record
_MISSING, _GAP = 1.5, 10.0  # usual steps: a missing sample of an even record, a gap of another
_TIMES_LIMIT = 2.0  # inputs beyond this many times the limits are in another unit
TIMES_DT = 50.0  # likewise sampling times this many times the plant's
_TIMES_SCALE = 10.0  # likewise outputs beyond this many times their typical size


LEAVE_OUT = "--rows START:STOP takes a part of the file"


def require_columns(
    record: Record, description: PlantDescription, inputs_only: bool = False
) -> None:
    """Raises ValueError for a record that was made with other inputs and outputs."""
    made_with = record.metadata.get("plant")
    if not made_with or "columns" in record.metadata:
        return
    kinds = ("inputs",) if inputs_only else ("inputs", "outputs")
    found = [part["name"] for kind in kinds for part in made_with[kind]]
    needed = [name for kind in kinds for name in names_of(getattr(description, kind))]
    if found != needed:
        raise ValueError(
            f"{record.source or 'the record'} is of plant {made_with['name']!r} and has "
            f"{', '.join(found)}; plant {description.name!r} has {', '.join(needed)}"
        )


def require_playable(record: Record, description: PlantDescription) -> None:
    """Raises ValueError for another plant's inputs, and for inputs beyond its limits."""
    require_columns(record, description, inputs_only=True)
    require_even(record, "an input to play needs one sampling time")
    require_within_limits(record.inputs, description, str(record.source or "the record"))


def require_within_limits(inputs: np.ndarray, description: PlantDescription, what: str) -> None:
    """Raises ValueError for inputs to play, by sample and input, that would be clipped.

    Another number of inputs is refused where they are played.
    """
    for part, values in zip(description.inputs, inputs.T, strict=False):
        low, high = values.min(), values.max()
        if low < part.lower - 1e-9 or high > part.upper + 1e-9:
            unit = f" {part.unit}" if part.unit else ""
            raise ValueError(
                f"{what}: {part.name!r} runs from {low:g} to {high:g}{unit}; the plant's limits "
                f"are {part.lower:g} to {part.upper:g}{unit}"
            )


def check_finite(values: np.ndarray, name: str, path: Path) -> None:
    """Raises ValueError where a column holds a value that is not finite."""
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise ValueError(
            f"{path}: sample {bad[0] + 1} of {name!r} is {values[bad[0]]}; "
            f"{bad.size} of {values.size} samples are not finite numbers ({LEAVE_OUT})"
        )


def check_time(time: np.ndarray, path: Path) -> None:
    """Raises ValueError for sampling instants that do not increase."""
    if time.size < 2:
        raise ValueError(f"{path}: {time.size} samples; at least two are needed")
    check_finite(time, "time", path)
    bad = np.flatnonzero(np.diff(time) <= 0)
    if bad.size:
        k = bad[0]
        what = "is there twice" if time[k + 1] == time[k] else "goes backwards"
        raise ValueError(
            f"{path}: 'time' {what}: sample {k + 1} is at {time[k]:.6g} s, sample {k + 2} at "
            f"{time[k + 1]:.6g} s; {bad.size} of {time.size - 1} steps do not increase "
            f"({LEAVE_OUT}; --dt gives a sampling time instead)"
        )


def is_even(time: np.ndarray) -> bool:
    """Whether sampling instants lie on a grid, but for the rounding of a file."""
    grid = np.linspace(time[0], time[-1], time.size)
    return bool(np.max(np.abs(time - grid)) <= _UNEVEN * (grid[1] - grid[0]))


def unbroken(time: np.ndarray) -> list[slice]:
    """Parts of a record without a gap in time, of two samples or more.

    In an even record a gap is a missing sample, because the input in between is unknown; in an
    uneven one it is a step of more than ten times a usual one. Of two topics at almost the same
    instants every other step is very short, so that a usual step is not the median one.
    """
    steps = np.diff(time)
    usual = np.median(steps)
    most_are_usual = np.mean(np.abs(steps - usual) <= _UNEVEN * usual) >= _MOST
    longest = _MISSING * usual if most_are_usual else _GAP * np.quantile(steps, _MOST)
    gaps = np.flatnonzero(steps > longest) + 1
    ends = [0, *gaps.tolist(), time.size]
    return [slice(a, b) for a, b in pairwise(ends) if b - a > 1]


def require_even(record: Record, what: str) -> None:
    """Raises ValueError where a record is sampled unevenly or has gaps."""
    if len(unbroken(record.time)) > 1 or not is_even(record.time):
        raise ValueError(
            f"{record.source or 'the record'} is sampled unevenly or has gaps in time; {what}"
        )


def check_size(values: np.ndarray, part: Input | Output, path: Path) -> None:
    """Raises ValueError for values so large that their unit must be wrong."""
    own = ""
    if isinstance(part, Input):
        own = ". Or the limits in the plant are too narrow"
        middle, half = (part.upper + part.lower) / 2, (part.upper - part.lower) / 2
        excess, allowed = np.abs(values - middle) / half, _TIMES_LIMIT
        expected = f"the plant's limits are {part.lower:g} to {part.upper:g} {part.unit}"
    else:
        excess, allowed = np.abs(values) / part.scale, _TIMES_SCALE
        expected = f"a usual size is {part.scale:g} {part.unit}"
    beyond, worst = np.flatnonzero(excess > allowed), values[np.nanargmax(excess)]
    if beyond.size:
        raise ValueError(
            f"{path}: {part.name!r} reaches {worst:g} {part.unit}, {expected}; "
            f"is it in another unit? {unit_hint(part.name)}{own}. {beyond.size} of {values.size} "
            f"samples are that large, the first is {beyond[0] + 1} ({LEAVE_OUT})"
        )


def unit_hint(name: str) -> str:
    """What to do about a column in another unit."""
    return (
        f"Give a scale, --scale {name}=FACTOR (1 confirms that the unit is right), or the unit, "
        f"--unit {name}=UNIT"
    )
