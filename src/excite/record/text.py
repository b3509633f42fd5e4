"""Text files of numbers from any source: .csv, .txt, .dat, .tsv.

A look at the first lines finds what separates the columns and whether they have names. Plain
CSV, as excite writes it, is then read by NumPy, and everything else by pandas.
"""

from __future__ import annotations

import contextlib
import csv
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from .table import require_pandas

_FIRST = 20  # lines that show the layout
_LONGEST = 64 * 2**10  # bytes of a line
_MOST_LINES = 20_000_000
_SKIPPED = (b"#", b"%", b"sep=")  # comments, and Excel's note about its delimiter
_DELIMITERS = (";", "\t", " ", ",")  # a blank stands for a run of blanks and tabs
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*|,\d+)?|[.,]\d+)([eE][+-]?\d+)?|nan", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_DATE = re.compile(r"\d{1,4}([-./])\d{1,2}\1\d{1,4}\b.*")
_TRUNCATED = "is the file truncated?"
_CLOCK = re.compile(r"(\d+ days? )?\d{1,2}:\d\d:\d\d\b.*")


@dataclass(frozen=True)
class _Look:
    """What a pass over the lines of a text file shows.

    Attributes:
        first: its first lines that are neither empty nor a comment, at most twenty.
        start: index of the first of them.
        comments: indices of the lines to skip.
        last: its last line, likewise.
        num_lines: up to that line.
        ends: whether the file ends with a line break.
    """

    first: list[str]
    start: int
    comments: list[int]
    last: str
    num_lines: int
    ends: bool
    encoding: str


def read_text(path: Path, is_own: bool = False) -> dict[str, np.ndarray]:
    """Columns of a text file by name, as numbers, or where a cell is no number as texts.

    Columns without any name are called "1", "2", ..., one without a name among others
    "column 1"; a column that is there twice is taken once.

    Args:
        path: the file.
        is_own: whether excite wrote the file, which then ends with a line break.

    Raises:
        ValueError: one sentence for a file that is no such table, or may be truncated.
    """
    look = _look(path)
    delimiter, names, is_named = _layout(look.first[:2])
    header = _cells(look.first[0], delimiter)
    if is_named and len(look.first) > 1:
        found = len(_cells(look.first[1], delimiter))
        if not len(names) - (not names[-1]) <= found <= len(names):
            why = "put names that hold blanks in quotes" if delimiter == " " else _TRUNCATED
            raise _wrong_width(path, look.start + 2, found, len(header), why)
    _require_whole(path, look, delimiter, names, is_own)
    is_plain = delimiter == "," and is_named and not (look.comments or look.start)
    if is_plain and len(look.first) > 1 and len(set(names)) == len(names) and all(names):
        # anything that NumPy cannot read is read, or explained, below
        with contextlib.suppress(ValueError):
            values = np.loadtxt(
                path, delimiter=",", skiprows=1, ndmin=2, comments=None, encoding=look.encoding
            )
            return dict(zip(names, values.T.copy(), strict=True))
    return _named(names, _read_cells(path, look, delimiter, len(names), is_named))


def _look(path: Path) -> _Look:
    """One pass over the lines, in little memory."""
    first, start, comments, last, count, encoding = [], 0, [], b"", 0, "utf-8-sig"
    line = b"\n"
    with path.open("rb") as file:
        for i, line in enumerate(iter(partial(file.readline, _LONGEST), b"")):
            if len(line) == _LONGEST:
                raise _no_text(path, f"line {i + 1} is longer than {_LONGEST >> 10} KiB")
            if i == _MOST_LINES:
                millions = f"{_MOST_LINES // 10**6} million lines"
                raise ValueError(f"{path}: the file has more than {millions}; save it with fewer")
            if b"\0" in line:
                raise _no_text(path, f"line {i + 1} holds zero bytes")
            text = line.removeprefix(b"\xef\xbb\xbf") if i == 0 else line
            if text.lstrip().startswith(_SKIPPED):
                comments.append(i)
            elif text.strip():
                try:
                    text.decode()
                except UnicodeDecodeError:
                    encoding = "cp1252"  # of a program that knows no UTF-8
                start = start if first else i
                first, last, count = [*first, text] if len(first) < _FIRST else first, text, i + 1
    if not first:
        raise ValueError(f"{path}: the file is empty")
    try:
        lines = [text.decode(encoding) for text in (*first, last)]
    except UnicodeDecodeError as error:
        raise _no_text(path, str(error)) from None
    return _Look(lines[:-1], start, comments, lines[-1], count, line.endswith(b"\n"), encoding)


def _no_text(path: Path, why: str) -> ValueError:
    return ValueError(f"{path}: cannot be read as CSV text ({why}); save it as UTF-8 text")


def _wrong_width(
    path: Path, line: int, found: int, named: int, why: str = _TRUNCATED
) -> ValueError:
    return ValueError(
        f"{path}: line {line} has {found} values where the header names {named}; {why}"
    )


def _cells(line: str, delimiter: str) -> list[str]:
    """The cells of a line, without the blanks around them."""
    line = " ".join(line.split()) if delimiter == " " else line.strip("\r\n")
    try:
        [row] = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    except (csv.Error, ValueError):
        row = [line]
    return [cell.strip() for cell in row]


def _layout(first: Sequence[str]) -> tuple[str, list[str], bool]:
    """The delimiter, the names of the columns, and whether the file names them.

    The delimiter is the one that splits the first two lines alike, and into most numbers. The
    names may hold commas between semicolons, the numbers decimal commas.
    """

    def quality(delimiter: str) -> tuple[bool, int, bool, int]:
        rows = [_cells(line, delimiter) for line in first]
        numbers = sum(bool(_NUMBER.fullmatch(cell)) for cell in rows[-1])
        excess = len(rows[-1]) - len(rows[0])
        is_alike = excess == 0 or (abs(excess) == 1 and not rows[excess > 0][-1])  # an empty end
        return is_alike and numbers > 0, numbers, is_alike, 0 if numbers else len(rows[0])

    delimiter = max(_DELIMITERS, key=quality)
    names, *rest = (_cells(line, delimiter) for line in first)
    if all(not cell or _NUMBER.fullmatch(cell) or _DATE.fullmatch(cell) for cell in names):
        return delimiter, [str(i) if name else "" for i, name in enumerate(names, 1)], False
    if rest and len(rest[0]) == len(names) + 1 and not rest[0][-1]:
        names = [*names, ""]  # every line but the first ends with a delimiter
    return delimiter, names, True


def _require_whole(
    path: Path, look: _Look, delimiter: str, names: Sequence[str], is_own: bool
) -> None:
    """Raises ValueError where the last line seems to be cut off."""
    row = _cells(look.last, delimiter)
    width = len(names) - (not names[-1])  # a column without name may be missing
    if look.num_lines > look.start + 1 and len(row) < width:
        raise _wrong_width(path, look.num_lines, len(row), width)
    if not look.ends and (is_own or not row[width - 1]):
        # A truncated number is still a number: only the line's end shows that it is complete.
        raise ValueError(
            f"{path}: line {look.num_lines} does not end with a line break; is the file truncated? "
            "(add one if it is complete)"
        )


def _read_cells(
    path: Path, look: _Look, delimiter: str, width: int, is_named: bool
) -> list[np.ndarray]:
    """The columns, by pandas."""
    pandas = require_pandas(
        f"{path}: a text file that is not plain CSV (names, commas, a number in every cell)"
    )
    rows = [*look.first[is_named:], look.last]
    has_commas = any(_DECIMAL_COMMA.fullmatch(c) for row in rows for c in _cells(row, delimiter))
    decimal = "," if delimiter != "," and has_commas else "."
    header = [look.start] if is_named else []
    try:
        with warnings.catch_warnings(action="error", category=pandas.errors.ParserWarning):
            frame = pandas.read_csv(
                path,
                sep=r"\s+" if delimiter == " " else delimiter,
                decimal=decimal,
                header=None,
                names=range(width),
                index_col=False,
                skiprows=[*look.comments, *header],
                skipinitialspace=True,
                keep_default_na=False,
                low_memory=False,
                encoding=look.encoding,
            )
    except (pandas.errors.ParserError, pandas.errors.ParserWarning) as error:
        if found := re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", str(error)):
            named, line, cells = map(int, found.groups())
            raise _wrong_width(path, line, cells, named) from None
        raise _no_text(path, str(error).strip()) from None
    except (UnicodeError, OSError) as error:
        raise _no_text(path, str(error)) from None
    columns = [frame[i].to_numpy() for i in frame]
    return [_numbers_or_texts(column, decimal) for column in columns]


def _numbers_or_texts(column: np.ndarray, decimal: str) -> np.ndarray:
    if column.dtype.kind in "fiub":
        return column.astype(float)
    texts = (str(cell).strip() for cell in column)
    return np.array([text.replace(decimal, ".") for text in texts], object)


def _named(names: Sequence[str], columns: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Columns by name; different ones of one name are told apart by their numbers."""
    found: dict[str, list[tuple[int, np.ndarray]]] = {}
    for i, (name, column) in enumerate(zip(names, columns, strict=True), 1):
        if not name and column.dtype == object and not any(column):
            continue  # an empty column behind a delimiter at the end of each line
        same = found.setdefault(name or f"column {i}", [])
        if not any(_is_equal(column, other) for _, other in same):
            same.append((i, column))
    return {
        name if len(same) == 1 else f"{name} (column {i})": column
        for name, same in found.items()
        for i, column in same
    }


def _is_equal(column: np.ndarray, other: np.ndarray) -> bool:
    both_numbers = column.dtype.kind == other.dtype.kind == "f"
    return np.array_equal(column, other, equal_nan=both_numbers)


def seconds_of(dates: np.ndarray) -> np.ndarray:
    """Seconds since the first of the dates or times of day, NaN for what is neither.

    01/02/2026 is read month first or day first, whichever gives the shorter record.
    """
    pandas = require_pandas("dates as time")
    if dates.dtype.kind == "O" and _CLOCK.fullmatch(str(dates[0])):
        stamps = pandas.to_timedelta(pandas.Index(dates), errors="coerce")
        return (stamps - stamps[0]).total_seconds().to_numpy()
    ways = ({"format": "ISO8601"}, {"dayfirst": False}, {"dayfirst": True})
    best = np.full(len(dates), np.nan)
    with warnings.catch_warnings(action="ignore"):  # about the ways that do not fit
        for way in ways:
            stamps = pandas.to_datetime(pandas.Index(dates), utc=True, errors="coerce", **way)
            seconds = (stamps - stamps[0]).total_seconds().to_numpy()
            if _quality(seconds) > _quality(best):
                best = seconds
    return best


def _quality(seconds: np.ndarray) -> tuple[int, float]:
    """How many dates were understood, and how short the record is."""
    known = seconds[np.isfinite(seconds)]
    return known.size, -np.ptp(known) if known.size else -np.inf
