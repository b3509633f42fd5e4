"""Columns as a pandas DataFrame."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas


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
