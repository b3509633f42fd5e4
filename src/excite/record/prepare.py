"""Checks of a recorded experiment: sampling, finite numbers, units, limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..description import Input, Output, PlantDescription, names_of
from .record import Record

_UNEVEN = 0.05  # of the sampling time: more than rounding in the file explains
_TIMES_LIMIT = 2.0  # inputs beyond this many times the limits are in another unit
TIMES_DT = 50.0  # likewise sampling times this many times the plant's
_TIMES_SCALE = 10.0  # likewise outputs beyond this many times their typical size


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
    """Raises ValueError for another plant's inputs, or beyond limits: they would be clipped."""
    require_columns(record, description, inputs_only=True)
    for part, values in zip(description.inputs, record.inputs.T, strict=True):
        if values.min() < part.lower - 1e-9 or values.max() > part.upper + 1e-9:
            raise ValueError(
                f"{record.source}: {part.name!r} runs from {values.min():g} to {values.max():g} "
                f"{part.unit}; the plant's limits are {part.lower:g} to {part.upper:g} {part.unit}"
            )


def check_finite(values: np.ndarray, name: str, path: Path) -> None:
    """Raises ValueError where a column holds a value that is not finite."""
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise ValueError(
            f"{path}: sample {bad[0] + 1} of {name!r} is {values[bad[0]]}; "
            f"{bad.size} of {values.size} samples are not finite numbers"
        )


def check_time(time: np.ndarray, path: Path) -> None:
    """Raises ValueError for sampling instants that do not increase evenly."""
    if time.size < 2:
        raise ValueError(f"{path}: {time.size} samples; at least two are needed")
    check_finite(time, "time", path)
    steps = np.diff(time)
    usual = float(np.median(steps))
    if usual <= 0:
        raise ValueError(f"{path}: 'time' does not increase")
    bad = np.flatnonzero(np.abs(steps - usual) > _UNEVEN * usual)
    if bad.size:
        k, gap = bad[0], steps[bad[0]]
        what = "samples are missing" if gap > 1.5 * usual else "sampling is uneven"
        raise ValueError(
            f"{path}: {what}: {gap:.6g} s between samples {k + 1} and {k + 2}, "
            f"{usual:.6g} s elsewhere; one sampling time within {_UNEVEN:.0%} is needed"
        )


def check_size(values: np.ndarray, part: Input | Output, path: Path) -> None:
    """Raises ValueError for values so large that their unit must be wrong."""
    if isinstance(part, Input):
        middle, half = (part.upper + part.lower) / 2, (part.upper - part.lower) / 2
        worst = values[np.argmax(np.abs(values - middle))]
        excess, allowed = abs(worst - middle) / half, _TIMES_LIMIT
        expected = f"the plant's limits are {part.lower:g} to {part.upper:g} {part.unit}"
    else:
        worst = values[np.argmax(np.abs(values))]
        excess, allowed = abs(worst) / part.scale, _TIMES_SCALE
        expected = f"a usual size is {part.scale:g} {part.unit}"
    if excess > allowed:
        raise ValueError(
            f"{path}: {part.name!r} reaches {worst:g} {part.unit}, {expected}; "
            f"is it in another unit? {unit_hint(part.name)}"
        )


def unit_hint(name: str) -> str:
    """What to do about a column in another unit."""
    return (
        f"Give a scale, {name}=FACTOR (1 confirms that the unit is right), or the unit, "
        f"--unit {name}=UNIT"
    )
