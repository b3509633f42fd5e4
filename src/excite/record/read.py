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
import reprlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..description import (
    Input,
    Output,
    PlantDescription,
    as_number,
    by_name,
    names_of,
    path_from,
    wrong_type,
)
from .bags import is_bag
from .dates import seconds_of
from .formats import columns_in
from .prepare import (
    LEAVE_OUT,
    TIMES_DT,
    check_finite,
    check_size,
    check_time,
    require_playable,
    unit_hint,
)
from .record import Record, described_in, read_sidecar
from .table import DataFrame, columns_of
from .text import require_one_decimal_sign
from .units import unit_factor

SIGNAL_ENDINGS = (".csv", ".mat")
_ALLOWED = "a path or a DataFrame"
_SAMPLING_TIME = ("Ts", "dt")  # columns that may hold it in their first row
_THOUSANDS = re.compile(r"[+-]?\d{1,3}([,.' \u2019\u00a0\u202f]\d{3})+([.,]\d+)?")
_MOST_NAMES, _LONGEST_NAME = 30, 100  # of a file's columns in a message


def read_record(
    path: str | os.PathLike[str] | DataFrame,
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
    """The experiment in a file or a DataFrame, checked against a plant.

        >>> import excite as ex, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ex.simulate("aero2", steps=100).save(f"{folder}/r.csv")
        ...     ex.read_record(f"{folder}/r.csv").inputs.shape
        (101, 1)

    Args:
        path: the file; its ending tells its kind: .csv, .txt, .dat, .tsv, .mat, .h5, .hdf5,
            .parquet, .mcap, .db3; a ROS 2 bag may be a folder. Or a pandas DataFrame with the same
            columns; an index with a name or of times is a column, too.
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

    An output may be missing in some samples, where it is NaN.

    Raises:
        ValueError: one sentence for anything that cannot be used: an unreadable or
            truncated file, a missing column or input, an infinite value, times that do not
            increase, values far outside what the plant can do.
    """
    frame, chosen = path if isinstance(path, DataFrame) else None, _slice_of(rows)
    path = path_from("record", path, _ALLOWED) if frame is None else Path("the DataFrame")
    if description is None:
        description = described_in(path if frame is None else frame)
    if not isinstance(description, PlantDescription):
        raise wrong_type("description", description, "that of a plant (plant.description)")
    given = {"columns": columns, "scales": scales, "units": units, "set_inputs": set_inputs}
    options = _Options(description, **{n: by_name(n, v) for n, v in given.items()}, dt=dt)
    signals = (*description.inputs, *(() if inputs_only else description.outputs))
    cells, dt = _cells(path, frame, options, names_of(signals))
    num_samples = _num_samples(path, cells)
    cells |= {name: np.full(num_samples, value) for name, value in options.set_inputs.items()}
    where = path if rows is None else Path(f"{path} (rows {_text_of(chosen)} of {num_samples})")
    if dt is None:
        time = _seconds(cells["time"][chosen], options, where)
    else:
        time = dt * np.arange(num_samples)[chosen]
    check_time(time, where)
    if options.dt is None:
        _check_unit_of_time(time, options, where)
    values = [_values(cells[part.name][chosen], part, options, where) for part in signals]
    num_inputs, first = len(description.inputs), chosen.indices(num_samples)[0]
    metadata = {} if frame is not None else _metadata(path, description, first)
    return Record(
        time=time,
        inputs=np.reshape(values[:num_inputs], (-1, len(time))).T,
        outputs=np.reshape(values[num_inputs:], (-1, len(time))).T,
        metadata=metadata,
        source=str(path) if frame is None else "",
    )


@dataclass(frozen=True)
class _Options:
    """What `read_record` is told about the file.

    Raises:
        ValueError: for a name that the plant does not have, or a value that is not allowed.
    """

    description: PlantDescription
    columns: Mapping[str, str]
    scales: Mapping[str, float]
    units: Mapping[str, str]
    set_inputs: Mapping[str, float]
    dt: float | None

    def __post_init__(self) -> None:
        for name in (*self.columns, *self.scales, *self.units):
            self._require_known(name, "column", self.description.columns)
        for name, factor in self.scales.items():
            as_number(f"scale of {name!r}", factor)
            if not (np.isfinite(factor) and factor != 0):
                raise ValueError(
                    f"scale {factor:g} of {name!r} is not allowed: finite and not zero"
                )
        for name in self.units:
            self.factor(name)
        for name, value in self.set_inputs.items():
            self._require_known(name, "input", names_of(self.description.inputs))
            as_number(f"value of input {name!r}", value)
            if not np.isfinite(value):
                raise ValueError(
                    f"value {value:g} of input {name!r} is not allowed: a finite number"
                )
            if name in self.columns:
                raise ValueError(f"input {name!r} is a column or a set value; give one of them")
        if self.dt is None:
            return
        as_number("dt", self.dt)
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"sampling time {self.dt:g} s is not allowed: finite and positive")
        if "time" in {*self.columns, *self.scales, *self.units}:
            raise ValueError(
                "--dt is the sampling time in seconds of a file without time; give it, or column, "
                "unit and scale of 'time'"
            )

    def _require_known(self, name: str, kind: str, known: Collection[str]) -> None:
        if name not in known:
            raise ValueError(
                f"plant {self.description.name!r} has no {kind} {_short(name)!r}"
                f"{_nearest(name, known)}; it has {', '.join(known)}"
            )

    def column(self, name: str) -> str:
        """The file's name of a quantity."""
        return str(self.columns.get(name, name))

    def factor(self, name: str) -> float:
        """The factor from the file's unit of a quantity to the plant's."""
        parts = (*self.description.inputs, *self.description.outputs)
        unit = next((part.unit for part in parts if part.name == name), "s")
        return self.scales.get(name, 1.0) * unit_factor(name, self.units.get(name, unit), unit)

    def confirms(self, name: str) -> bool:
        """Whether a factor of 1, or the plant's own unit, says that the unit is right."""
        if name in self.scales:
            return self.scales[name] == 1
        return name in self.units and self.factor(name) == 1


_ROWS = re.compile(r"(-?\d{1,18})?:(-?\d{1,18})?(?::(\d{1,18})?)?")


def _slice_of(rows: slice | str | None) -> slice:
    """The rows to use, from a Python slice or its text."""
    found = _ROWS.fullmatch(rows.replace(" ", "")) if isinstance(rows, str) else None
    told = reprlib.repr(rows)
    if found:
        rows = slice(*(None if number is None else int(number) for number in found.groups()))
    rows = slice(None) if rows is None else rows
    if not isinstance(rows, slice) or (rows.step is not None and rows.step < 1):
        raise ValueError(
            f"rows {told} are not allowed: START:STOP or START:STOP:STEP, counted "
            "from 0 below the names, such as 100:1000:5"
        )
    return rows


def _text_of(rows: slice) -> str:
    parts = [rows.start, rows.stop, *([] if rows.step is None else [rows.step])]
    return ":".join("" if part is None else str(part) for part in parts)


def _cells(
    path: Path, frame: DataFrame | None, options: _Options, signals: Sequence[str]
) -> tuple[dict[str, np.ndarray], float | None]:
    """The file's columns by the plant's names, with `time`; or without it the sampling time [s]."""
    needed = [name for name in ("time", *signals) if name not in options.set_inputs]
    if options.dt is not None:
        needed.remove("time")
    given = [options.column(name) for name in needed]
    if twice := [n for n, column in zip(needed, given, strict=True) if given.count(column) > 1]:
        raise ValueError(f"{path}: {' and '.join(map(repr, twice))} cannot be the same column")
    if options.dt is not None and is_bag(path):
        raise ValueError(f"{path}: its messages have their times; --dt is for a file without time")
    inputs = names_of(options.description.inputs)
    held = [column for name, column in zip(needed, given, strict=True) if name in inputs]
    table = columns_in(path, given, held) if frame is None else columns_of(frame)
    if in_file := [name for name in options.set_inputs if name in table]:
        raise ValueError(
            f"{path}: the file has a column {in_file[0]!r}; --set-input is for inputs that it does "
            "not have"
        )
    if "time" in needed and options.column("time") not in table and "time" not in options.columns:
        for name in _SAMPLING_TIME:
            if name in table and _is_in_first_row_only(table[name]):
                table["time"] = table[name]
    if missing := [name for name in needed if options.column(name) not in table]:
        raise _no_column(table, missing[0], options, path)
    cells = {name: table[options.column(name)] for name in needed}
    for column in cells.values():
        require_one_decimal_sign(column, path)
    if "time" not in cells or not _is_in_first_row_only(cells["time"]):
        return cells, options.dt
    return cells, options.factor("time") * float(cells.pop("time")[0])


def _num_samples(path: Path, cells: Mapping[str, np.ndarray]) -> int:
    """The number of samples, the same in all columns."""
    if not cells:
        raise ValueError(f"{path}: with all inputs set and a sampling time nothing is left to read")
    (first, num_samples), *others = ((name, len(column)) for name, column in cells.items())
    for name, found in others:
        if found != num_samples:
            raise ValueError(f"{path}: {name!r} has {found} samples, {first!r} {num_samples}")
    return num_samples


def _nearest(name: str, names: Iterable[str]) -> str:
    """A question with the nearest name, upper and lower case alike; empty where none is near."""
    lower = {known.lower(): known for known in names}
    near = difflib.get_close_matches(name.lower(), lower, n=1)
    return f" (did you mean {lower[near[0]]!r}?)" if near else ""


def _no_column(
    table: Mapping[str, np.ndarray], name: str, options: _Options, path: Path
) -> ValueError:
    """What the file has instead of a column, and the options that mend it."""
    column, names = options.column(name), list(table)
    ways = f"--column {name}=NAME"
    if name == "time":
        ways += ", or give a sampling time with --dt"
    elif name in names_of(options.description.inputs):
        ways += f", or a constant value with --set-input {name}=VALUE"
    if several := [known for known in names if known.startswith(f"{column} (column ")]:
        return ValueError(
            f"{path}: column {column!r} is there twice, with different values: "
            f"{' or '.join(several)} (choose one with {ways})"
        )
    listed = ", ".join(map(_short, names[:_MOST_NAMES])) or "none"
    if len(names) > _MOST_NAMES:
        listed += f" and {len(names) - _MOST_NAMES} more"
    if names and names == [str(i) for i in range(1, len(names) + 1)]:
        listed = f"no names, its columns are called {listed}"
    return ValueError(
        f"{path}: no column {_short(column)!r}{_nearest(column, names)}; the file has {listed} "
        f"(name it with {ways})"
    )


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST_NAME else f"{text[:_LONGEST_NAME]}..."


def _is_in_first_row_only(cells: np.ndarray) -> bool:
    """Whether a column has a number in its first row, and nothing below."""
    first = _number(cells[0]) if cells.size else None
    if first is None or not math.isfinite(first):
        return False
    below = cells[1:]
    return all(np.isnan(below)) if below.dtype.kind == "f" else not any(map(_is_there, below))


def _is_there(cell: object) -> bool:
    return cell is not None and bool(str(cell).strip())


def _number(cell: Any) -> float | None:
    """A cell as a number, NaN included; None for text, dates and empty cells."""
    try:
        return float(cell)
    except (TypeError, ValueError):
        return None


def _seconds(cells: np.ndarray, options: _Options, where: Path) -> np.ndarray:
    """Time in seconds, from numbers or dates."""
    has_dates, has_durations = cells.dtype.kind == "M", cells.dtype.kind == "m"
    if cells.dtype.kind == "O" and cells.size:
        has_dates = _is_there(cells[0]) and _number(cells[0]) is None
    if not has_dates and not has_durations:
        return _numbers(cells, "time", where) * options.factor("time")
    seconds = cells / np.timedelta64(1, "s") if has_durations else seconds_of(cells)
    if (bad := np.flatnonzero(np.isnan(seconds))).size:
        raise _bad_cell(cells, int(bad[0]), "time", "neither a number nor a date", where)
    if options.factor("time") != 1:
        raise ValueError(
            f"{where}: 'time' holds {'durations' if has_durations else 'dates'}, which are read as "
            "seconds; leave its unit and scale out"
        )
    return seconds


def _check_unit_of_time(time: np.ndarray, options: _Options, where: Path) -> None:
    step, plant = float(time[1] - time[0]), options.description
    if step > TIMES_DT * plant.dt and not options.confirms("time"):
        raise ValueError(
            f"{where}: sampled every {step:g} s, where {plant.name!r} is every {plant.dt:g} s; is "
            f"'time' in another unit? {unit_hint('time')}. If it is right, dt in the plant is wrong"
        )


def _values(cells: np.ndarray, part: Input | Output, options: _Options, where: Path) -> np.ndarray:
    """A column in the plant's unit; ValueError where its size shows that the unit is wrong.

    An output that was not measured in a sample is NaN.
    """
    if isinstance(part, Output) and cells.dtype.kind == "O":
        cells = np.array([cell if _is_there(cell) else np.nan for cell in cells], object)
    values = _numbers(cells, part.name, where) * options.factor(part.name)
    measured = ~np.isnan(values) if isinstance(part, Output) else np.ones(len(values), bool)
    if not measured.any():
        raise ValueError(f"{where}: {part.name!r} has no measurement in {len(values)} samples")
    check_finite(np.where(measured, values, 0.0), part.name, where)
    if not options.confirms(part.name):
        check_size(values, part, where)
    return values


def _numbers(cells: np.ndarray, name: str, where: Path) -> np.ndarray:
    """The numbers of a column; ValueError names the first cell that is none."""
    if cells.dtype.kind in "Mm":
        raise _bad_cell(cells, 0, name, "not a number", where)
    try:
        return cells.astype(float)
    except (TypeError, ValueError):
        pass
    bad = next(k for k, cell in enumerate(cells) if _number(cell) is None)
    raise _bad_cell(cells, bad, name, "not a number", where)


def _bad_cell(cells: np.ndarray, k: int, name: str, what: str, where: Path) -> ValueError:
    """What a cell holds that cannot be read, and what mends it."""
    text = str(cells[k]).strip()
    found = f"is {_short(text)!r}, {what}" if _is_there(cells[k]) else "is missing"
    if _THOUSANDS.fullmatch(text):
        found += "; save the file without thousands separators"
    elif k:
        found += f"; {LEAVE_OUT}"
    else:
        found += "; every row below the names must hold numbers (--rows 1: leaves out the first)"
    return ValueError(f"{where}: sample {k + 1} of {name!r} {found}")


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
