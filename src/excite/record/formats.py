"""Columns of experiment files of every kind, by name: text, MAT, HDF5 and Parquet."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from .record import TEXT_ENDINGS, read_sidecar, require_matlab, require_readable
from .text import read_text

_MAX_UNPACKED = 256 * 2**20  # bytes of all columns of a file, which may be compressed
_MAT_NUMBERS = re.compile(r"double|single|u?int(8|16|32|64)|logical")


def columns_in(path: Path) -> dict[str, np.ndarray]:
    """Columns of a file by name: numbers, dates, or where a cell is no number texts.

    Raises:
        ValueError: one sentence for a file that cannot be read.
    """
    require_readable(path)
    ending = path.suffix.lower()
    try:
        if ending in TEXT_ENDINGS:
            return read_text(path, is_own=bool(read_sidecar(path)))
        if ending == ".mat":
            return _read_mat(path)
        return _read_parquet(path) if ending == ".parquet" else _read_hdf5(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error})") from None


def _require_size(path: Path, size: int) -> None:
    if size > _MAX_UNPACKED:
        sizes = f"{size / 2**20:.0f} MiB unpacked, more than {_MAX_UNPACKED >> 20}"
        raise ValueError(f"{path}: its columns take {sizes}; save it with fewer of them")


def _no_column(path: Path, kind: str, found: list[str]) -> ValueError:
    return ValueError(
        f"{path}: each column must be a {kind} that is a vector of numbers; the file holds "
        f"{', '.join(found) or 'nothing'}"
    )


def _is_vector(shape: tuple[int, ...]) -> bool:
    return max(shape, default=0) == math.prod(shape) > 1


def _read_mat(path: Path) -> dict[str, np.ndarray]:
    """Vectors of numbers in a MAT file; nothing else of it is loaded."""
    reader = require_matlab(path)
    try:
        listed = reader.whosmat(path)
        names = [
            n for n, shape, kind in listed if _MAT_NUMBERS.fullmatch(kind) and _is_vector(shape)
        ]
        size = 8 * sum(math.prod(shape) for name, shape, _ in listed if name in names)
        is_small = size <= _MAX_UNPACKED
        content = reader.loadmat(path, variable_names=names) if names and is_small else {}
    except NotImplementedError:  # MAT files of version 7.3 are HDF5
        return _read_hdf5(path)
    except Exception as error:  # for a damaged file the reader raises any type
        raise ValueError(f"{path}: not a readable MAT file ({error})") from None
    _require_size(path, size)
    if not names:
        found = [f"{name} ({'x'.join(map(str, shape))} {kind})" for name, shape, kind in listed]
        raise _no_column(path, "variable", found)
    vectors = {name: content[name] for name in names if name in content}
    return {n: np.asarray(v, float).ravel() for n, v in vectors.items() if v.dtype.kind in "fiu"}


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

    try:
        with h5py.File(path, "r") as file:
            file.visititems(collect)
            vectors = {
                name: part
                for name, part in found.items()
                if part.dtype.kind in "fiub" and _is_vector(part.shape)
                and not (part.is_virtual or part.external)  # they are in another file
            }  # fmt: skip
            listed = [f"{name} ({part.dtype})" for name, part in found.items()]
            size = 8 * sum(part.size for part in vectors.values())
            is_small = size <= _MAX_UNPACKED
            columns = {n: part[()].astype(float).ravel() for n, part in vectors.items() if is_small}
    except Exception as error:  # for a damaged file the library raises any type
        kind = "a MAT file of version 7.3" if path.suffix.lower() == ".mat" else "HDF5"
        raise ValueError(
            f"{path}: cannot be read as {kind} ({error}); save it again"
            + (" with -v7 or as CSV" if path.suffix.lower() == ".mat" else "")
        ) from None
    _require_size(path, size)
    if not columns:
        raise _no_column(path, "dataset", listed)
    return columns


def _require_parquet(path: Path) -> ModuleType:
    try:
        import pyarrow.parquet
    except ImportError:
        raise ValueError(
            f"{path}: Parquet files need the extra: pip install 'excite[logs]'"
        ) from None
    return pyarrow.parquet


def _read_parquet(path: Path) -> dict[str, np.ndarray]:
    parquet = _require_parquet(path)
    try:
        with parquet.ParquetFile(path) as file:
            size = 8 * file.metadata.num_rows * file.metadata.num_columns
            table = file.read() if size <= _MAX_UNPACKED else file.schema_arrow.empty_table()
    except Exception as error:  # for a damaged file the library raises any type
        raise ValueError(f"{path}: not a readable Parquet file ({error})") from None
    _require_size(path, size)
    frame = table.to_pandas(ignore_metadata=True)  # an index is a column, too
    return {str(name): _of_frame(column) for name, column in frame.items()}


def _of_frame(column: Any) -> np.ndarray:
    if column.dtype.kind in "fiub":
        return column.to_numpy(float)
    if column.dtype.kind == "M":
        is_zoned = getattr(column.dtype, "tz", None) is not None
        return (column.dt.tz_convert(None) if is_zoned else column).to_numpy()
    return column.to_numpy(object)
