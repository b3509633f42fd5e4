"""Pandas DataFrames, which need not be installed: to write, and as records."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

if TYPE_CHECKING:
    import pandas


@runtime_checkable
class DataFrame(Protocol):
    """A pandas DataFrame, known by what it can do: pandas takes long to import."""

    columns: Any
    index: Any
    items: Any
    reset_index: Any


def require_pandas(what: str) -> ModuleType:
    """pandas; ValueError where it is not installed, with `what` needs it."""
    try:  # a laboratory computer runs experiments without it
        import pandas
    except ImportError:
        raise ValueError(f"{what} needs pandas: pip install pandas") from None
    return pandas


def data_frame(columns: Mapping[str, object], index: object = None) -> pandas.DataFrame:
    """Columns as a pandas DataFrame; ValueError where pandas is not installed."""
    return require_pandas("to_pandas").DataFrame(columns, index)


def columns_of(frame: DataFrame) -> dict[str, np.ndarray]:
    """Columns of a DataFrame by name: numbers, dates, durations, or other things as they are.

    An index that has a name, or holds dates or durations, is a column, too; without a name it is
    `time`.

    Raises:
        ValueError: for a name that is there twice, or several levels of names.
    """
    if frame.index.nlevels > 1:
        raise ValueError(
            f"the DataFrame has {frame.index.nlevels} levels of row names; one is allowed "
            "(reset_index makes columns of them)"
        )
    if frame.index.name is not None or frame.index.dtype.kind in "Mm":
        name = "time" if frame.index.name is None else frame.index.name
        if name not in frame.columns:
            frame = frame.reset_index(names=[name])
    if frame.columns.nlevels > 1:
        raise ValueError(
            f"the DataFrame has {frame.columns.nlevels} levels of column names; one is allowed"
        )
    names = [str(name) for name in frame.columns]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"the DataFrame has the column {twice[0]!r} twice")
    return {name: column_of(column) for name, (_, column) in zip(names, frame.items(), strict=True)}


def column_of(column: Any) -> np.ndarray:
    """A column of a DataFrame: numbers, dates without a zone, durations, or objects."""
    kind = column.dtype.kind
    if kind in "fiub":
        return column.to_numpy(float, na_value=np.nan)
    if kind == "m":
        return column.to_numpy()
    if kind == "M":
        is_zoned = getattr(column.dtype, "tz", None) is not None
        return (column.dt.tz_convert(None) if is_zoned else column).to_numpy()
    return column.astype(object).where(column.notna(), None).to_numpy(object)
