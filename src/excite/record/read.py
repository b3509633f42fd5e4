"""Reads experiment files.

An experiment file has the columns `time`, the plant's inputs and its outputs, in SI units or
in units that the caller names: row k holds the outputs measured at time[k] and the inputs held
from time[k] to time[k + 1]. A JSON file of the same name beside it (the sidecar) gives the
plant, its parameters if known, and how the experiment began.
"""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..description import PlantDescription, names_of, path_from
from .formats import columns_in
from .prepare import TIMES_DT, check_finite, check_size, check_time, require_playable, unit_hint
from .record import Record, described_in, read_sidecar
from .text import seconds_of
from .units import unit_factor

SIGNAL_ENDINGS = (".csv", ".mat")
_SAMPLING_TIME = ("Ts", "dt")  # columns that hold it in their first row
_MOST_NAMES = 30  # of a file's columns in a message


def read_record(
    path: str | os.PathLike[str],
    description: PlantDescription | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    *,
    units: Mapping[str, str] | None = None,
    set_inputs: Mapping[str, float] | None = None,
    dt: float | None = None,
    rows: slice | str | None = None,
    inputs_only: bool = False,
) -> Record:
    """The experiment in a file, checked against a plant.

        >>> import excite as ex, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ex.simulate("aero2", steps=100).save(f"{folder}/r.csv")
        ...     ex.read_record(f"{folder}/r.csv").inputs.shape
        (101, 1)

    Args:
        path: the file; its ending tells its kind: .csv, .txt, .dat, .tsv, .mat, .h5, .hdf5,
            .parquet.
        description: the plant; default that of the sidecar.
        columns: names in the file where they are not the plant's: {"pitch": "qm"}. Columns of a
            file without names are "1", "2", ...
        scales: factors from the file's unit to the plant's: {"pitch": 0.01745}.
        units: the file's units where they are not the plant's: {"time": "ms", "pitch": "deg"}.
        set_inputs: values of constant inputs that the file does not have: {"voltage": 5.0}.
        dt: sampling time of a file without time [s].
        rows: rows to use, counted from 0 below the names: slice(100, 1000, 5) or "100:1000:5".
        inputs_only: whether the file is a designed input without outputs; the record
            then has none either.

    Raises:
        ValueError: one sentence for anything that cannot be used: an unreadable or
            truncated file, a missing column or sample, a value that is not finite,
            uneven sampling, values far outside what the plant can do.
    """
    path, columns, scales = path_from("record", path), columns or {}, scales or {}
    units, set_inputs, chosen = units or {}, set_inputs or {}, _slice_of(rows)
    if description is None:
        description = described_in(path)
    _check_options(description, columns, scales, units, set_inputs, dt)
    quantities = (*description.inputs, *(() if inputs_only else description.outputs))
    unit_of = {"time": "s", **{part.name: part.unit for part in quantities}}
    unit_factors = {n: unit_factor(n, units.get(n, unit), unit) for n, unit in unit_of.items()}
    factors = {name: scales.get(name, 1.0) * factor for name, factor in unit_factors.items()}
    confirmed = {  # a factor of one says that the unit is right, whatever the size
        name
        for name, factor in unit_factors.items()
        if scales.get(name, factor if name in units else None) == 1
    }
    needed = [name for name in unit_of if name not in set_inputs and (name != "time" or dt is None)]
    cells = _cells(path, description, needed, columns, set_inputs)
    if not cells:
        raise ValueError(f"{path}: with all inputs set and --dt nothing is left to read")
    samples = {name: len(column) for name, column in cells.items()}
    first, num_samples = next(iter(samples.items()))
    if others := [name for name in samples if samples[name] != num_samples]:
        raise ValueError(
            f"{path}: {others[0]!r} has {samples[others[0]]} samples, {first!r} {num_samples}"
        )
    where = path if rows is None else Path(f"{path} (rows {_text_of(chosen)} of {num_samples})")
    if dt is None:
        time = _seconds(cells["time"], chosen, factors["time"], where)
    else:
        time = dt * np.arange(num_samples)[chosen]
    check_time(time, where)
    step = float(time[1] - time[0])
    if dt is None and step > TIMES_DT * description.dt and "time" not in confirmed:
        raise ValueError(
            f"{path}: sampled every {step:g} s, where {description.name!r} is every "
            f"{description.dt:g} s; is 'time' in another unit? {unit_hint('time')}"
        )
    values: dict[str, np.ndarray] = {}
    for part in quantities:
        if part.name in set_inputs:
            column = np.full(len(time), float(set_inputs[part.name]))
        else:
            column = _numbers(cells[part.name][chosen], part.name, where)
        values[part.name] = column * factors[part.name]
        check_finite(values[part.name], part.name, where)
        if part.name not in confirmed:
            check_size(values[part.name], part, where)
    inputs, outputs = names_of(description.inputs), names_of(quantities)[len(description.inputs) :]
    return Record(
        time=time,
        inputs=np.stack([values[name] for name in inputs], axis=1),
        outputs=np.array([values[name] for name in outputs]).reshape(-1, len(time)).T,
        metadata=_metadata(path, description, chosen.indices(num_samples)[0]),
        source=str(path),
    )


def _check_options(
    description: PlantDescription,
    columns: Mapping[str, str],
    scales: Mapping[str, float],
    units: Mapping[str, str],
    set_inputs: Mapping[str, float],
    dt: float | None,
) -> None:
    """Raises ValueError for a name that the plant does not have, or a value that is not allowed."""
    for name in (*columns, *scales, *units):
        if name not in description.columns:
            raise ValueError(
                f"plant {description.name!r} has no column {name!r}"
                f"{_nearest(name, description.columns)}; it has {', '.join(description.columns)}"
            )
    for name, factor in scales.items():
        if not (np.isfinite(factor) and factor != 0):
            raise ValueError(f"scale {factor:g} of {name!r} is not allowed: finite and not zero")
    inputs = names_of(description.inputs)
    for name, value in set_inputs.items():
        if name not in inputs:
            raise ValueError(
                f"plant {description.name!r} has no input {name!r}{_nearest(name, inputs)}; it has "
                f"{', '.join(inputs)}"
            )
        if not np.isfinite(value):
            raise ValueError(f"value {value:g} of input {name!r} is not allowed: a finite number")
        if name in columns:
            raise ValueError(f"input {name!r} is a column or a set value; give one of them")
    if dt is not None and not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"sampling time {dt:g} s is not allowed: finite and positive")
    if dt is not None and "time" in {*columns, *scales, *units}:
        raise ValueError(
            "--dt is the sampling time in seconds of a file without time; give it, or column, unit "
            "and scale of 'time'"
        )


_ROWS = re.compile(r"(-?\d+)?:(-?\d+)?(?::(\d+)?)?")


def _slice_of(rows: slice | str | None) -> slice:
    """The rows to use, from a Python slice or its text."""
    found = _ROWS.fullmatch(rows.replace(" ", "")) if isinstance(rows, str) else None
    if found:
        rows = slice(*(None if number is None else int(number) for number in found.groups()))
    rows = slice(None) if rows is None else rows
    if not isinstance(rows, slice) or (rows.step is not None and rows.step < 1):
        raise ValueError(
            f"rows {rows!r} are not allowed: START:STOP or START:STOP:STEP, counted from 0 below "
            "the names, such as 100:1000:5"
        )
    return rows


def _text_of(rows: slice) -> str:
    parts = [rows.start, rows.stop, *([] if rows.step is None else [rows.step])]
    return ":".join("" if part is None else str(part) for part in parts)


def _cells(
    path: Path,
    description: PlantDescription,
    needed: list[str],
    columns: Mapping[str, str],
    set_inputs: Mapping[str, float],
) -> dict[str, np.ndarray]:
    """The columns that are needed, as the file has them, by the plant's names."""
    given = [columns.get(name, name) for name in needed]
    if twice := [n for n, column in zip(needed, given, strict=True) if given.count(column) > 1]:
        raise ValueError(f"{path}: {' and '.join(map(repr, twice))} cannot be the same column")
    table = columns_in(path)
    if is_there := [name for name in set_inputs if name in table]:
        raise ValueError(
            f"{path}: the file has a column {is_there[0]!r}; --set-input is for inputs that it "
            "does not have"
        )
    found = {}
    for name, column in zip(needed, given, strict=True):
        if name == "time" and column not in table and name not in columns:
            own = [n for n in _SAMPLING_TIME if n in table and _is_in_first_row_only(table[n])]
            column = own[0] if own else column
        if column not in table:
            other = ", or give a sampling time with --dt" if name == "time" else ""
            if name in names_of(description.inputs):
                other = f", or a constant value with --set-input {name}=VALUE"
            raise _no_column(table, column, f"--column {name}=NAME{other}", path)
        found[name] = table[column]
    return found


def _nearest(name: str, names: Iterable[str]) -> str:
    """A question with the nearest name, upper and lower case alike; empty where none is near."""
    lower = {known.lower(): known for known in names}
    near = difflib.get_close_matches(name.lower(), lower, n=1)
    return f" (did you mean {lower[near[0]]!r}?)" if near else ""


def _no_column(
    table: Mapping[str, np.ndarray], column: str, options: str, path: Path
) -> ValueError:
    """What the file has instead of a column, and the options that mend it."""
    names = list(table)
    several = [n for n in names if n.startswith(f"{column} (column ")]
    if several:
        return ValueError(
            f"{path}: column {column!r} is there twice, with different values: "
            f"{' or '.join(several)} (choose one with {options})"
        )
    listed = ", ".join(names[:_MOST_NAMES]) or "none"
    if len(names) > _MOST_NAMES:
        listed += f" and {len(names) - _MOST_NAMES} more"
    if names and names == [str(i) for i in range(1, len(names) + 1)]:
        listed = f"no names, its columns are called {listed}"
    return ValueError(
        f"{path}: no column {column!r}{_nearest(column, names)}; the file has {listed} (name it "
        f"with {options})"
    )


def _is_in_first_row_only(cells: np.ndarray) -> bool:
    """Whether a column has a number in its first row, and nothing below."""
    if cells.dtype.kind == "f":
        return len(cells) > 1 and bool(np.isfinite(cells[0]) and np.isnan(cells[1:]).all())
    if cells.dtype.kind != "O" or len(cells) < 2 or any(map(_is_there, cells[1:])):
        return False
    return _number(cells[0]) is not None


def _is_there(cell: object) -> bool:
    return cell is not None and bool(str(cell).strip())


def _number(cell: Any) -> float | None:
    """A cell as a number, NaN included; None for text, dates and empty cells."""
    try:
        return float(cell)
    except (TypeError, ValueError):
        return None


def _seconds(cells: np.ndarray, chosen: slice, factor: float, where: Path) -> np.ndarray:
    """The time of the chosen rows [s]: from numbers, dates, or one sampling time in the first."""
    if _is_in_first_row_only(cells):
        return factor * float(cells[0]) * np.arange(len(cells))[chosen]
    column = cells[chosen]
    is_date = column.dtype.kind == "M"
    if column.dtype.kind == "O" and column.size:
        is_date = _is_there(column[0]) and _number(column[0]) is None
    if not is_date:
        return _numbers(column, "time", where) * factor
    seconds = seconds_of(column)
    if (bad := np.flatnonzero(np.isnan(seconds))).size:
        raise ValueError(
            f"{where}: sample {bad[0] + 1} of 'time' is {str(column[bad[0]])!r}, neither a number "
            f"nor a date{_FIRST_ROW if bad[0] == 0 else ''}"
        )
    if factor != 1:
        raise ValueError(
            f"{where}: 'time' holds dates, which are read as seconds; leave its unit and scale out"
        )
    return seconds


_FIRST_ROW = "; every row below the names must hold numbers (--rows 1: leaves out the first)"


def _numbers(cells: np.ndarray, name: str, where: Path) -> np.ndarray:
    """The numbers of a column; ValueError names the first cell that is none."""
    try:
        if cells.dtype.kind != "M":
            return cells.astype(float)
    except (TypeError, ValueError):
        pass
    bad = next(k for k, cell in enumerate(cells) if _number(cell) is None)
    cell = cells[bad]
    found = f"is {str(cell)!r}, not a number" if _is_there(cell) else "is missing"
    raise ValueError(
        f"{where}: sample {bad + 1} of {name!r} {found}{_FIRST_ROW if bad == 0 else ''}"
    )


def _metadata(path: Path, description: PlantDescription, first_row: int) -> Mapping[str, Any]:
    """The sidecar; with `columns`, where the file's were mapped to those of another plant."""
    sidecar = read_sidecar(path)
    if sidecar and first_row > 0:
        sidecar = {**sidecar, "starts_at_initial_state": False}
    if not sidecar.get("plant"):
        return sidecar
    own = PlantDescription.from_dict(sidecar["plant"]).columns
    mapped = {} if own == description.columns else {"columns": list(description.columns)}
    return {**sidecar, **mapped}


def read_signal(path: Path, description: PlantDescription) -> Record:
    """The designed input in a file, to be played on a plant unchanged.

    Raises:
        ValueError: as `read_record`, and for another sampling time or inputs beyond the limits.
    """
    record = read_record(path, description, inputs_only=True)
    if not math.isclose(record.dt, description.dt, rel_tol=1e-6):
        raise ValueError(
            f"{path}: its sampling time is {record.dt:g} s; {description.name!r} has "
            f"{description.dt:g} s"
        )
    require_playable(record, description)
    return record
