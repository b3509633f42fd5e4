"""Experiment files and run folders: the only things that cross from computing to showing.

An experiment file is CSV or MAT with the columns `time`, the plant's inputs and its
outputs, in SI units: row k holds the outputs measured at time[k] and the inputs held from
time[k] to time[k + 1]. A JSON file of the same name beside it (the sidecar) says which
plant it was, which parameters, and how the experiment began.
"""

from __future__ import annotations

import io
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

try:  # a laboratory computer runs experiments without it, on CSV files
    import scipy.io as matlab
except ImportError:
    matlab = None

from .description import Input, Output, PlantDescription, names_of
from .files import csv_text, require_new_file, text_columns, write_bytes, write_json

RECORD_KIND = "excite record"
_UNEVEN = 0.05  # of the sampling time: more than printing it with few digits explains
_TIMES_LIMIT = 2.0  # inputs beyond this many times the limits are in another unit
_TIMES_DT = 50.0  # likewise sampling times this many times the plant's
_TIMES_SCALE = 10.0  # likewise outputs beyond this many times their typical size
_MAX_UNPACKED = 256 * 2**20  # bytes of all columns of a MAT file, which is compressed
_MAT_NUMBERS = re.compile(r"double|single|u?int(8|16|32|64)|logical")


@dataclass(frozen=True)
class Record:
    """One recorded experiment.

    Attributes:
        time: sampling instants [s].
        inputs: by sample and input; row k is held from time[k] on, the last acts after the end.
        outputs: measured, by sample and output.
        metadata: what the sidecar says; empty without one.
        source: where the record came from, for messages.
    """

    time: np.ndarray
    inputs: np.ndarray
    outputs: np.ndarray
    metadata: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""

    @classmethod
    def of_episode(
        cls,
        time: Any,
        inputs: Any,
        outputs: Any,
        metadata: Mapping[str, Any] | None = None,
        source: str = "",
    ) -> Record:
        """A record of T + 1 samples from T inputs; its last row goes on holding the last."""
        inputs = np.asarray(inputs)
        held = np.concatenate([inputs, inputs[-1:]])
        return cls(np.asarray(time), held, np.asarray(outputs), metadata or {}, source)

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @property
    def starts_at_initial_state(self) -> bool:
        """Whether the sidecar says that the plant was at its initial state."""
        return self.metadata.get("starts_at_initial_state") is True


def read_record(
    path: str | os.PathLike[str],
    description: PlantDescription,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    *,
    inputs_only: bool = False,
) -> Record:
    """The experiment in a CSV or MAT file, checked against a plant.

    Args:
        path: the file; its ending tells its kind.
        columns: names in the file where they are not the plant's: {"pitch": "qm"}.
        scales: factors from the file's unit to the plant's: {"pitch": 0.01745}.
        inputs_only: whether the file is a designed input without outputs; the record
            then has none either.

    Raises:
        ValueError: one sentence for anything that cannot be used: an unreadable or
            truncated file, a missing column or sample, a value that is not finite,
            uneven sampling, values far outside what the plant can do.
    """
    path, columns, scales = Path(path), columns or {}, scales or {}
    for name in (*columns, *scales):
        if name not in description.columns:
            raise ValueError(
                f"plant {description.name!r} has no column {name!r}; "
                f"it has {', '.join(description.columns)}"
            )
    for name, factor in scales.items():
        if not (np.isfinite(factor) and factor != 0):
            raise ValueError(f"scale {factor:g} of {name!r} is not allowed: finite and not zero")
    outputs = () if inputs_only else description.outputs
    quantities = (*description.inputs, *outputs)
    needed = ["time", *names_of(quantities)]
    given = [columns.get(name, name) for name in needed]
    if twice := [n for n, column in zip(needed, given, strict=True) if given.count(column) > 1]:
        raise ValueError(f"{path}: {' and '.join(map(repr, twice))} cannot be the same column")
    table = columns_in(path)

    def read(name: str) -> np.ndarray:
        return _column(table, columns.get(name, name), name, path) * scales.get(name, 1.0)

    time = read("time")
    _check_time(time, path)
    dt = float(time[1] - time[0])
    if dt > _TIMES_DT * description.dt and scales.get("time") != 1:
        raise ValueError(
            f"{path}: sampled every {dt:g} s, where {description.name!r} is every "
            f"{description.dt:g} s; is 'time' in another unit? Give a factor (--scale "
            "time=FACTOR; 1 says that the unit is right)"
        )
    parts = {part.name: read(part.name) for part in quantities}
    for part in quantities:
        if len(parts[part.name]) != len(time):
            raise ValueError(
                f"{path}: {part.name!r} has {len(parts[part.name])} samples, 'time' {len(time)}"
            )
        _check_finite(parts[part.name], part.name, path)
        if scales.get(part.name) != 1:  # a factor of one says that the unit is right
            _check_size(parts[part.name], part, path)
    chosen = [parts[n] for n in names_of(outputs)]
    return Record(
        time=time,
        inputs=np.stack([parts[n] for n in names_of(description.inputs)], axis=1),
        outputs=np.stack(chosen, axis=1) if chosen else np.empty((len(time), 0)),
        metadata=_read_sidecar(path),
        source=str(path),
    )


def read_signal(path: Path, description: PlantDescription) -> Record:
    """The designed input in a file, to be played on a plant as it is.

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


def require_playable(record: Record, description: PlantDescription) -> None:
    """Raises ValueError for inputs beyond the limits: they would be clipped into others."""
    for part, values in zip(description.inputs, record.inputs.T, strict=True):
        if values.min() < part.lower - 1e-9 or values.max() > part.upper + 1e-9:
            raise ValueError(
                f"{record.source}: {part.name!r} runs from {values.min():g} to {values.max():g} "
                f"{part.unit}; the plant's limits are {part.lower:g} to {part.upper:g} {part.unit}"
            )


def columns_in(path: Path) -> dict[str, np.ndarray | list[str]]:
    """Columns of a CSV or MAT file by name, those of a CSV file still as text.

    Raises:
        ValueError: one sentence for a file that cannot be read.
    """
    _require_record_ending(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    return _read_mat(path) if path.suffix.lower() == ".mat" else {**text_columns(path)}


def _require_record_ending(path: Path) -> None:
    if path.suffix.lower() not in (".csv", ".mat"):
        raise ValueError(f"{path}: experiment files end in .csv or .mat")


def require_record_path(path: Path, overwrite: bool) -> None:
    """Raises ValueError, before anything is computed, where no record may be written."""
    _require_record_ending(path)
    sidecar = path.with_suffix(".json")
    if sidecar.is_file() and not _read_sidecar(path):
        raise ValueError(f"{sidecar} is no sidecar of a record and would be lost; rename one")
    require_new_file(path, overwrite)


def _require_matlab(path: Path) -> Any:
    if matlab is None:
        raise ValueError(
            f"{path}: MAT files need SciPy (python -m pip install scipy); CSV does not"
        )
    return matlab


def _read_mat(path: Path) -> dict[str, np.ndarray | list[str]]:
    reader = _require_matlab(path)
    try:
        names, size = _vectors_in(listed := reader.whosmat(path))
        is_small = size <= _MAX_UNPACKED
        content = reader.loadmat(path, variable_names=names) if names and is_small else {}
    except NotImplementedError:
        raise ValueError(
            f"{path}: MAT files of version 7.3 are HDF5; save it with -v7 or as CSV"
        ) from None
    except Exception as error:  # a damaged file makes the reader fail in any way
        raise ValueError(f"{path}: not a readable MAT file ({error})") from None
    if not is_small:
        sizes = f"{size / 2**20:.0f} MiB unpacked, more than {_MAX_UNPACKED >> 20}"
        raise ValueError(f"{path}: its columns take {sizes}; save it with fewer of them")
    if not names:
        found = [f"{name} ({'x'.join(map(str, shape))} {kind})" for name, shape, kind in listed]
        raise ValueError(
            f"{path}: columns are vectors of numbers, each a variable of its own, and it holds "
            f"{', '.join(found) or 'nothing'}"
        )
    vectors = {name: content[name] for name in names if name in content}
    return {n: np.asarray(v, float).ravel() for n, v in vectors.items() if v.dtype.kind in "fiu"}


def _vectors_in(listed: list[tuple[str, tuple[int, ...], str]]) -> tuple[list[str], int]:
    """Names of all vectors of numbers in a MAT file, and their bytes; nothing else is loaded."""
    vectors = {
        name: math.prod(shape)
        for name, shape, kind in listed
        if _MAT_NUMBERS.fullmatch(kind) and max(shape, default=0) == math.prod(shape) > 1
    }
    return list(vectors), 8 * sum(vectors.values())


def _column(
    table: Mapping[str, np.ndarray | list[str]], name: str, meaning: str, path: Path
) -> np.ndarray:
    if name not in table:
        raise ValueError(
            f"{path}: no column {name!r}; the file has {', '.join(table) or 'none'} "
            f"(name it so, or where files are identified map one with --column {meaning}=NAME)"
        )
    column = table[name]
    if isinstance(column, np.ndarray):
        return column
    values = np.empty(len(column))
    for row, text in enumerate(column):
        try:
            values[row] = float(text)
        except ValueError:
            found = f"is {text!r}, not a number" if text else "is missing"
            found += "; below the names there are only numbers" * (row == 0)
            raise ValueError(f"{path}: sample {row + 1} of {name!r} {found}") from None
    return values


def _check_finite(values: np.ndarray, name: str, path: Path) -> None:
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise ValueError(
            f"{path}: sample {bad[0] + 1} of {name!r} is {values[bad[0]]}; "
            f"{bad.size} of {values.size} samples are not finite numbers"
        )


def _check_time(time: np.ndarray, path: Path) -> None:
    if time.size < 2:
        raise ValueError(f"{path}: {time.size} samples; at least two are needed")
    _check_finite(time, "time", path)
    steps = np.diff(time)
    usual = float(np.median(steps))
    if usual <= 0:
        raise ValueError(f"{path}: 'time' does not grow")
    bad = np.flatnonzero(np.abs(steps - usual) > _UNEVEN * usual)
    if bad.size:
        k, gap = bad[0], steps[bad[0]]
        what = "samples are missing" if gap > 1.5 * usual else "sampling is uneven"
        raise ValueError(
            f"{path}: {what}: {gap:.6g} s between samples {k + 1} and {k + 2}, "
            f"{usual:.6g} s elsewhere; one sampling time within {_UNEVEN:.0%} is needed"
        )


def _check_size(values: np.ndarray, part: Input | Output, path: Path) -> None:
    """Values that only another unit can explain are refused."""
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
            f"is it in another unit? Give a factor (--scale {part.name}=FACTOR; 1 says that the "
            "unit is right)"
        )


def _read_sidecar(path: Path) -> Mapping[str, Any]:
    """The sidecar's content; empty where there is none, or where it is not ours."""
    sidecar = path.with_suffix(".json")
    if not sidecar.is_file():
        return {}
    try:
        content = json.loads(sidecar.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise ValueError(f"{sidecar}: cannot be read as JSON ({error})") from None
    if not (isinstance(content, dict) and content.get("kind") == RECORD_KIND):
        return {}
    plant = content.get("plant", {})
    if not isinstance(plant, dict):
        raise ValueError(f"{sidecar}: 'plant' is no plant description")
    if plant:
        try:
            PlantDescription.from_dict(plant)
        except ValueError as error:
            raise ValueError(f"{sidecar}: {error}") from None
    return content


def write_record(
    path: str | os.PathLike[str], record: Record, description: PlantDescription
) -> None:
    """Writes a record as CSV or MAT, as the ending says, and its sidecar.

    Raises:
        ValueError: for another ending, or a folder that does not exist.
    """
    path = Path(path)
    require_record_path(path, overwrite=True)
    values = np.column_stack([record.time, record.inputs, record.outputs]).T
    columns = dict(zip(description.columns, values, strict=True))
    buffer = io.BytesIO()
    if path.suffix.lower() == ".mat":
        _require_matlab(path).savemat(buffer, {n: v[:, None] for n, v in columns.items()})
    else:
        buffer.write(csv_text(columns).encode())
    # What an earlier sidecar says of the record's origin outlives later uses of it.
    sidecar = {
        "plant": description.to_dict(),
        "plant_hash": description.hash,
        **record.metadata,
        "kind": RECORD_KIND,
        "dt": record.dt,
    }
    # The sidecar first: a record without one would be read as one of unknown start.
    write_json(path.with_suffix(".json"), sidecar)
    write_bytes(path, buffer.getvalue())
