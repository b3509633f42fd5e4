"""Columns of experiment files of every kind, by name: text, MAT, HDF5, Parquet and bags."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from .bags import columns_of_bag, is_bag, read_bag
from .damage import MAX_UNPACKED, damage_reported, require_size
from .record import TEXT_ENDINGS, read_sidecar, require_matlab, require_readable
from .table import column_of
from .text import read_text

_MAT_NUMBERS = re.compile(r"double|single|u?int(8|16|32|64)|logical")


def columns_in(
    path: Path, wanted: Collection[str] | None = None, held: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """Columns of a file by name: numbers, dates, or where a cell is no number texts.

    A single number, such as a sampling time, is a column of one sample.

    Args:
        path: the file, or the folder of a ROS 2 bag.
        wanted: of a bag, where each topic has its own instants, the columns to join; default all.
        held: those of them that keep their value until the next message.

    Raises:
        ValueError: one sentence for a file that cannot be read.
    """
    require_readable(path)
    ending = path.suffix.lower()
    try:
        if is_bag(path):
            return read_bag(path, wanted, held)
        if ending in TEXT_ENDINGS:
            return _by_observable(path, read_text(path, is_own=bool(read_sidecar(path))))
        if ending == ".parquet":
            return _read_parquet(path)
        columns = _read_mat(path) if ending == ".mat" else _read_hdf5(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    return dict(sorted(columns.items(), key=lambda column: column[1].size == 1))  # vectors first


def column_lengths(path: Path) -> dict[str, int]:
    """The columns of a file by name, and how many samples each has.

    Raises:
        ValueError: one sentence for a file that cannot be read.
    """
    if is_bag(path):
        return columns_of_bag(path)
    return {name: len(values) for name, values in columns_in(path).items()}


def _by_observable(path: Path, table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A PEtab measurement table, one measurement in each row, as one column per observable.

    L. Schmiester et al., "PEtab: interoperable specification of parameter estimation problems in
    systems biology", PLoS Computational Biology 17, 2021. Other tables are returned unchanged.
    """
    if not {"observableId", "measurement", "time"} <= table.keys():
        return table
    conditions = sorted(set(map(str, table.get("simulationConditionId", ["one"]))))
    if len(conditions) > 1:
        raise ValueError(
            f"{path}: measured under {len(conditions)} conditions ({', '.join(conditions[:5])}); "
            "save each as a file of its own"
        )
    try:
        time, values = (table[name].astype(float) for name in ("time", "measurement"))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: 'time' or 'measurement' is not a number ({error})") from None
    instants, names = np.unique(time), table["observableId"].astype(str)
    columns = {"time": instants}
    for name in dict.fromkeys(names.tolist()):
        own = np.full(len(instants), np.nan)
        places = np.searchsorted(instants, time[names == name])
        if len(np.unique(places)) < len(places):
            raise ValueError(f"{path}: {name!r} is measured twice at the same time")
        own[places] = values[names == name]
        columns[name] = own
    return columns


def _no_column(path: Path, kind: str, found: list[str]) -> ValueError:
    return ValueError(
        f"{path}: each column must be a {kind} that is a vector of numbers; the file holds "
        f"{', '.join(found) or 'nothing'}"
    )


def _is_vector(shape: tuple[int, ...]) -> bool:
    """Whether at most one dimension is more than one; a single number is a vector, too."""
    return max(shape, default=1) == math.prod(shape) > 0


def _read_mat(path: Path) -> dict[str, np.ndarray]:
    """Vectors of numbers in a MAT file; nothing else of it is loaded."""
    reader = require_matlab(path)
    try:
        with damage_reported(path, "MAT"):
            listed = reader.whosmat(path)
    except NotImplementedError:  # MAT files of version 7.3 are HDF5
        return _read_hdf5(path)
    shapes = {
        name: shape
        for name, shape, kind in listed
        if _MAT_NUMBERS.fullmatch(kind) and _is_vector(shape)
    }
    if not shapes:
        found = [f"{name} ({'x'.join(map(str, shape))} {kind})" for name, shape, kind in listed]
        raise _no_column(path, "variable", found)
    require_size(path, 8 * sum(map(math.prod, shapes.values())))
    with damage_reported(path, "MAT"):
        content = reader.loadmat(path, variable_names=list(shapes))
    vectors = {name: content[name] for name in shapes if name in content}
    return {n: np.asarray(v, float).ravel() for n, v in vectors.items() if v.dtype.kind in "fiub"}


def _require_hdf5(path: Path) -> ModuleType:
    try:
        import h5py
    except ImportError:
        raise ValueError(
            f"{path}: HDF5 and MAT files of version 7.3 need h5py: pip install h5py"
        ) from None
    return h5py


def _read_hdf5(path: Path) -> dict[str, np.ndarray]:
    """Vectors of numbers in an HDF5 file by their paths, in the groups, too."""
    h5py = _require_hdf5(path)
    found: dict[str, Any] = {}

    def collect(name: str, part: Any) -> None:
        if isinstance(part, h5py.Dataset) and not name.startswith("#"):  # MATLAB's own are #refs#
            found[name] = part

    is_mat = path.suffix.lower() == ".mat"
    kind = ("MAT 7.3", "; save it again with -v7 or as CSV") if is_mat else ("HDF5",)
    with damage_reported(path, *kind), h5py.File(path, "r") as file:
        file.visititems(collect)
        vectors = {name: part for name, part in found.items() if _is_vector_of_numbers(part)}
        listed = [f"{name} ({part.dtype})" for name, part in found.items()]
        size = 8 * sum(part.size for part in vectors.values())
        is_small = size <= MAX_UNPACKED
        columns = {n: part[()].astype(float).ravel() for n, part in vectors.items() if is_small}
    require_size(path, size)
    if not columns:
        raise _no_column(path, "dataset", listed)
    return columns


def _is_vector_of_numbers(part: Any) -> bool:
    """Whether a dataset is a column: in this file, and neither MATLAB's text nor its empty []."""
    is_text = part.attrs.get("MATLAB_class") == b"char" or "MATLAB_empty" in part.attrs
    is_elsewhere = part.is_virtual or part.external
    is_number = part.dtype.kind in "fiub" and not is_text
    return is_number and not is_elsewhere and part.shape is not None and _is_vector(part.shape)


def _require_parquet(path: Path) -> ModuleType:
    try:
        import pyarrow.parquet
    except ImportError:
        raise ValueError(
            f"{path}: Parquet files need the extra: pip install 'excite[logs]'"
        ) from None
    return pyarrow


def _read_parquet(path: Path) -> dict[str, np.ndarray]:
    """Columns of numbers and dates in a Parquet file; texts, which may unpack to much, are not."""
    arrow = _require_parquet(path)
    with damage_reported(path, "Parquet"), arrow.parquet.ParquetFile(path) as file:
        kinds = {part.name: part.type for part in file.schema_arrow}
        is_kind = arrow.types.is_primitive, arrow.types.is_decimal
        names = [name for name, kind in kinds.items() if any(test(kind) for test in is_kind)]
        size = 8 * file.metadata.num_rows * len(names)
        table = file.read(names if size <= MAX_UNPACKED else [])
        frame = table.to_pandas(ignore_metadata=True)  # an index is a column, too
    require_size(path, size)
    if not names:
        raise _no_column(path, "column", [f"{name} ({kind})" for name, kind in kinds.items()])
    return {str(name): column_of(column) for name, column in frame.items()}
