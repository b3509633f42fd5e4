"""Reads experiment files.

An experiment file is CSV or MAT with the columns `time`, the plant's inputs and its
outputs, in SI units: row k holds the outputs measured at time[k] and the inputs held from
time[k] to time[k + 1]. A JSON file of the same name beside it (the sidecar) gives the
plant, its parameters if known, and how the experiment began.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..description import PlantDescription, names_of, path_from
from .prepare import TIMES_DT, check_finite, check_size, check_time, require_playable
from .record import Record, described_in, read_sidecar, require_matlab, require_record_ending
from .table import text_columns

_MAX_UNPACKED = 256 * 2**20  # bytes of all columns of a MAT file, which is compressed
_MAT_NUMBERS = re.compile(r"double|single|u?int(8|16|32|64)|logical")


def read_record(
    path: str | os.PathLike[str],
    description: PlantDescription | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    *,
    inputs_only: bool = False,
) -> Record:
    """The experiment in a CSV or MAT file, checked against a plant.

        >>> import excite as ex, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ex.simulate("aero2", steps=100).save(f"{folder}/r.csv")
        ...     ex.read_record(f"{folder}/r.csv").inputs.shape
        (101, 1)

    Args:
        path: the file; its ending tells its kind.
        description: the plant; default that of the sidecar.
        columns: names in the file where they are not the plant's: {"pitch": "qm"}.
        scales: factors from the file's unit to the plant's: {"pitch": 0.01745}.
        inputs_only: whether the file is a designed input without outputs; the record
            then has none either.

    Raises:
        ValueError: one sentence for anything that cannot be used: an unreadable or
            truncated file, a missing column or sample, a value that is not finite,
            uneven sampling, values far outside what the plant can do.
    """
    path, columns, scales = path_from("record", path), columns or {}, scales or {}
    if description is None:
        description = described_in(path)
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
    check_time(time, path)
    dt = float(time[1] - time[0])
    if dt > TIMES_DT * description.dt and scales.get("time") != 1:
        raise ValueError(
            f"{path}: sampled every {dt:g} s, where {description.name!r} is every "
            f"{description.dt:g} s; is 'time' in another unit? Give a scale, "
            "time=FACTOR (1 confirms that the unit is right)"
        )
    parts = {part.name: read(part.name) for part in quantities}
    for part in quantities:
        if len(parts[part.name]) != len(time):
            raise ValueError(
                f"{path}: {part.name!r} has {len(parts[part.name])} samples, 'time' {len(time)}"
            )
        check_finite(parts[part.name], part.name, path)
        if scales.get(part.name) != 1:  # a factor of one confirms the unit
            check_size(parts[part.name], part, path)
    chosen = [parts[n] for n in names_of(outputs)]
    return Record(
        time=time,
        inputs=np.stack([parts[n] for n in names_of(description.inputs)], axis=1),
        outputs=np.stack(chosen, axis=1) if chosen else np.empty((len(time), 0)),
        metadata=_metadata(path, description),
        source=str(path),
    )


def _metadata(path: Path, description: PlantDescription) -> Mapping[str, Any]:
    """The sidecar; with `columns`, where the file's were mapped to those of another plant."""
    sidecar = read_sidecar(path)
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


def columns_in(path: Path) -> dict[str, np.ndarray | list[str]]:
    """Columns of a CSV or MAT file by name, those of a CSV file still as text.

    Raises:
        ValueError: one sentence for a file that cannot be read.
    """
    require_record_ending(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    return _read_mat(path) if path.suffix.lower() == ".mat" else {**text_columns(path)}


def _read_mat(path: Path) -> dict[str, np.ndarray | list[str]]:
    reader = require_matlab(path)
    try:
        names, size = _vectors_in(listed := reader.whosmat(path))
        is_small = size <= _MAX_UNPACKED
        content = reader.loadmat(path, variable_names=names) if names and is_small else {}
    except NotImplementedError:
        raise ValueError(
            f"{path}: MAT files of version 7.3 are HDF5; save it with -v7 or as CSV"
        ) from None
    except Exception as error:  # for a damaged file the reader raises any type
        raise ValueError(f"{path}: not a readable MAT file ({error})") from None
    if not is_small:
        sizes = f"{size / 2**20:.0f} MiB unpacked, more than {_MAX_UNPACKED >> 20}"
        raise ValueError(f"{path}: its columns take {sizes}; save it with fewer of them")
    if not names:
        found = [f"{name} ({'x'.join(map(str, shape))} {kind})" for name, shape, kind in listed]
        raise ValueError(
            f"{path}: each column must be a variable that is a vector of numbers; the file holds "
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
            f"(rename it, or where files are identified give --column {meaning}=NAME)"
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
            found += "; every row below the names must hold numbers" * (row == 0)
            raise ValueError(f"{path}: sample {row + 1} of {name!r} {found}") from None
    return values


SIGNAL_ENDINGS = (".csv", ".mat")
