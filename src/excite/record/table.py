"""Tables: CSV files from any source as columns of text, columns as a pandas DataFrame."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas


def text_columns(path: Path) -> dict[str, list[str]]:
    """Columns of a CSV file from any source, by name, as text.

    Raises:
        ValueError: one sentence for a file that is not such a table, or may be truncated.
    """
    delimiter, (first, *rest) = _rows(path)
    header = [name.strip() or f"column {i}" for i, name in enumerate(first, 1)]
    if first and all(map(_is_number, first)):
        raise ValueError(f"{path}: the first line holds numbers; the columns' names are needed")
    if len(set(header)) < len(header):
        raise ValueError(f"{path}: the header names a column twice: {', '.join(header)}")
    body = [(number, row) for number, row in enumerate(rest, 2) if row]
    for number, row in body:
        if len(row) != len(header):
            raise ValueError(
                f"{path}: line {number} has {len(row)} values where the header names "
                f"{len(header)}; is the file truncated?"
            )
    point = "," if delimiter == ";" else "."  # of a German or French table
    cells = [[cell.strip().replace(point, ".") for cell in row] for _, row in body]
    return {name: [row[i] for row in cells] for i, name in enumerate(header)}


def _rows(path: Path) -> tuple[str, list[list[str]]]:
    """The delimiter of a CSV file, and its rows, one or more, as text."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise ValueError(
            f"{path}: cannot be read as CSV text ({error}); save it as UTF-8"
        ) from None
    lines = text.splitlines()
    if not lines:
        raise ValueError(f"{path}: the file is empty")
    try:
        delimiter = _delimiter(lines[:2])
        rows = list(csv.reader(lines, delimiter=delimiter))
    except csv.Error as error:
        raise ValueError(f"{path}: cannot be read as CSV text ({error})") from None
    if not text.endswith(("\n", "\r")):
        # A truncated number is still a number: only the line's end shows that it is complete.
        raise ValueError(
            f"{path}: line {len(lines)} does not end with a line break; is the file truncated? "
            "(add one if it is complete)"
        )
    return delimiter, rows


def _delimiter(first: list[str]) -> str:
    """The character that splits the first two lines alike; names and numbers may hold commas."""
    for delimiter in (";", "\t", ","):
        counts = {len(row) for row in csv.reader(first, delimiter=delimiter)}
        if len(counts) == 1 and counts != {1}:
            return delimiter
    return next((d for d in (",", ";", "\t") if d in first[0]), ",")


def _is_number(text: str) -> bool:
    try:
        return bool(text) and math.isfinite(float(text.replace(",", ".")))
    except ValueError:
        return False


def data_frame(columns: Mapping[str, object], index: object = None) -> pandas.DataFrame:
    """Columns as a pandas DataFrame; ValueError where pandas is not installed."""
    try:
        import pandas
    except ImportError:
        raise ValueError("to_pandas needs pandas: pip install pandas") from None
    return pandas.DataFrame(columns, index)  # pyright: ignore[reportArgumentType]
