"""Text files of numbers from any source: .csv, .txt, .dat, .tsv.

A look at the first lines finds what separates the columns and whether they have names. Plain
CSV, as excite writes it, is then read by NumPy, and everything else by pandas.
"""

from __future__ import annotations

import codecs
import csv
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from .dates import DATE
from .table import require_pandas

_FIRST = 20  # lines that show the layout
_LONGEST = 2**16  # characters of a line
_MOST_LINES = 20_000_000
_SKIPPED = ("#", "%", "sep=")  # comments, and Excel's note about its delimiter
_DELIMITERS = (";", "\t", " ", ",")  # a blank stands for a run of blanks and tabs
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*|,\d+)?|[.,]\d+)([eE][+-]?\d+)?|nan", re.IGNORECASE)
_DECIMAL_POINT = re.compile(r"[+-]?\d*\.\d+([eE][+-]?\d+)?")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_COMMA_OF_SECONDS = re.compile(r"(?<=:\d\d),(?=\d)")
_SENTENCE = re.compile(
    r"\b(and|are|at|by|for|from|is|of|the|to|was|were|with)\b|[.:!?]\s*$", re.IGNORECASE
)
_TRUNCATED = "is the file truncated?"


@dataclass(frozen=True)
class _Look:
    """What a pass over the lines of a text file shows.

    Attributes:
        rows: its first lines that are neither empty nor a comment, at most twenty, each with
            its index.
        last: its last such line, with its index.
        comments: indices of the lines to skip.
        above: the comment directly above the first row; empty where there is none.
        ends: whether the file ends with a line break.
    """

    rows: list[tuple[int, str]]
    last: tuple[int, str]
    comments: list[int]
    above: str
    ends: bool
    encoding: str


@dataclass(frozen=True)
class _Layout:
    """How the rows of a text file are read.

    Attributes:
        names: of the columns; empty for one without a name.
        is_named: whether the first row has the names.
    """

    delimiter: str
    names: list[str]
    is_named: bool

    @property
    def width(self) -> int:
        """Cells that every row has; one in a last column without a name may be missing."""
        return len(self.names) - (not self.names[-1])


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
    layout = _layout(look)
    _require_whole(path, look, layout, is_own)
    columns = _read_plain(path, look, layout)
    if columns is None:
        columns = _read_cells(path, look, layout)
    return _named(layout.names, columns)


def _look(path: Path) -> _Look:
    """One pass over the lines, in little memory."""
    with path.open("rb") as file:
        is_utf16 = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    reason = ""
    for encoding in ("utf-16",) if is_utf16 else ("utf-8-sig", "cp1252"):  # cp1252: old Windows
        try:
            return _look_in(path, encoding)
        except UnicodeDecodeError as error:
            reason = f"byte {error.object[error.start]:#04x} is no character"
    raise _no_text(path, reason)


def _look_in(path: Path, encoding: str) -> _Look:
    rows, last, comments, comment, above = [], (0, ""), [], "", ""
    line = "\n"
    with path.open(encoding=encoding) as file:
        for i, line in enumerate(iter(partial(file.readline, _LONGEST), "")):
            if len(line) == _LONGEST:
                raise _no_text(path, f"line {i + 1} is longer than {_LONGEST} characters")
            if i == _MOST_LINES:
                millions = f"{_MOST_LINES // 10**6} million lines"
                raise ValueError(f"{path}: the file has more than {millions}; save it with fewer")
            if "\0" in line:
                raise _no_text(path, f"line {i + 1} holds zero bytes")
            if line.lstrip().startswith(_SKIPPED):
                comments.append(i)
                comment = line
            elif line.strip():
                last = i, line
                if not rows and comments and comments[-1] == i - 1:
                    above = comment
                if len(rows) < _FIRST:
                    rows.append(last)
    if not rows:
        raise ValueError(f"{path}: the file is empty")
    return _Look(rows, last, comments, above, line.endswith("\n"), encoding)


def _no_text(path: Path, why: str) -> ValueError:
    return ValueError(f"{path}: cannot be read as CSV text ({why}); save it as UTF-8 text")


def _cells(line: str, delimiter: str) -> list[str]:
    """The cells of a line, without the blanks around them."""
    line = " ".join(line.split()) if delimiter == " " else line.strip("\n")
    try:
        [row] = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    except (csv.Error, ValueError):
        row = [line]
    return [cell.strip() for cell in row]


def _layout(look: _Look) -> _Layout:
    """The delimiter and the names, from the first two rows and the comment above them."""
    first = [row for _, row in look.rows[:2]]
    delimiter = max(_DELIMITERS, key=lambda delimiter: _fitness(delimiter, first))
    cells, *rest = (_cells(row, delimiter) for row in first)
    if any(cell and not (_NUMBER.fullmatch(cell) or DATE.fullmatch(cell)) for cell in cells):
        has_empty_end = bool(rest) and len(rest[0]) == len(cells) + 1 and not rest[0][-1]
        return _Layout(delimiter, [*cells, *[""] * has_empty_end], True)
    empty_end = [""] if not cells[-1] else []
    numbers = [str(i) for i in range(1, len(cells) + 1 - len(empty_end))]
    names = _names_in_comment(look.above, len(numbers)) or numbers
    return _Layout(delimiter, [*names, *empty_end], False)


def _fitness(delimiter: str, first: Sequence[str]) -> tuple[bool, int, bool, int]:
    """How well a delimiter splits the first rows: alike, and the second into most numbers.

    The names may hold commas between semicolons, the numbers decimal commas.
    """
    rows = [_cells(row, delimiter) for row in first]
    numbers = sum(bool(_NUMBER.fullmatch(cell)) for cell in rows[-1])
    excess = len(rows[-1]) - len(rows[0])
    is_alike = excess == 0 or (abs(excess) == 1 and not rows[excess > 0][-1])  # an empty end
    return is_alike and numbers > 0, numbers, is_alike, 0 if numbers else len(rows[0])


def _names_in_comment(comment: str, width: int) -> list[str]:
    """The names in a comment such as `# t,u,y`, where it has one for each column.

    Words of a sentence are no names.
    """
    words = comment.lstrip("#% \t")
    for delimiter in (";", "\t", ",", " "):
        if delimiter in ", " and "[" not in words and _SENTENCE.search(words):
            return []
        names = _cells(words, delimiter)
        if len(names) == width and all(names) and not any(map(_NUMBER.fullmatch, names)):
            return names
    return []


def _require_whole(path: Path, look: _Look, layout: _Layout, is_own: bool) -> None:
    """Raises ValueError where the second or the last row has too few cells or too many."""
    for i, row in (*look.rows[1:2], look.last):
        num_cells = len(_cells(row, layout.delimiter))
        if not layout.width <= num_cells <= len(layout.names):
            may_be_blanks = layout.delimiter == " " and layout.is_named and i != look.last[0]
            why = "put names that hold blanks in quotes" if may_be_blanks else _TRUNCATED
            raise _wrong_width(path, i + 1, num_cells, layout.width, why)
    last_cell = _cells(look.last[1], layout.delimiter)[layout.width - 1]
    if not look.ends and (is_own or not last_cell):
        # A truncated number is still a number: only the line's end shows that it is complete.
        raise ValueError(
            f"{path}: line {look.last[0] + 1} does not end with a line break; {_TRUNCATED} (add "
            "one if it is complete)"
        )


def _wrong_width(path: Path, line: int, found: int, width: int, why: str) -> ValueError:
    return ValueError(
        f"{path}: line {line} has {found} values where the first row has {width}; {why}"
    )


def _read_plain(path: Path, look: _Look, layout: _Layout) -> list[np.ndarray] | None:
    """The columns of names, commas and numbers, by NumPy; None for any other file."""
    has_names_first = layout.is_named and look.rows[0][0] == 0 and len(look.rows) > 1
    if layout.delimiter != "," or look.comments or not has_names_first:
        return None
    try:
        values = np.loadtxt(
            path, delimiter=",", skiprows=1, ndmin=2, comments=None, encoding=look.encoding
        )
    except ValueError:  # a cell that is no number
        return None
    return list(values.T.copy()) if values.shape[1] == len(layout.names) else None


def _read_cells(path: Path, look: _Look, layout: _Layout) -> list[np.ndarray]:
    """The columns, by pandas."""
    pandas = require_pandas(
        f"{path}: a text file that is not plain CSV (names, commas, a number in every cell)"
    )
    header, rows = look.rows[: layout.is_named], look.rows[layout.is_named :]
    cells = (cell for _, row in (*rows, look.last) for cell in _cells(row, layout.delimiter))
    has_commas = layout.delimiter != "," and any(map(_DECIMAL_COMMA.fullmatch, cells))
    try:
        with warnings.catch_warnings(action="error", category=pandas.errors.ParserWarning):
            frame = pandas.read_csv(
                path,
                sep=r"\s+" if layout.delimiter == " " else layout.delimiter,
                decimal="," if has_commas else ".",
                header=None,
                names=range(len(layout.names)),
                index_col=False,
                skiprows=[*look.comments, *(i for i, _ in header)],
                skipinitialspace=True,
                keep_default_na=False,
                low_memory=False,
                encoding=look.encoding,
            )
    except (pandas.errors.ParserError, pandas.errors.ParserWarning) as error:
        if found := re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", str(error)):
            width, line, saw = map(int, found.groups())
            raise _wrong_width(path, line, saw, width, _TRUNCATED) from None
        raise _no_text(path, str(error).strip()) from None
    except (UnicodeError, OSError) as error:
        raise _no_text(path, str(error)) from None
    return [_numbers_or_texts(frame[i].to_numpy(), has_commas) for i in frame]


class _Pointed(str):
    """A number with a decimal point in a file with decimal commas: perhaps of thousands."""


def _numbers_or_texts(column: np.ndarray, has_commas: bool) -> np.ndarray:
    """A column of pandas: numbers, or texts in which decimal commas are points."""
    if column.dtype.kind in "fiub":
        return column.astype(float)
    texts = [str(cell).strip() for cell in column]
    return np.array(list(map(_with_point, texts)) if has_commas else texts, object)


def _with_point(text: str) -> str:
    if _DECIMAL_POINT.fullmatch(text):
        return _Pointed(text)
    number = text.replace(",", ".") if _DECIMAL_COMMA.fullmatch(text) else text
    return _COMMA_OF_SECONDS.sub(".", number)


def require_one_decimal_sign(column: np.ndarray, path: Path) -> None:
    """Raises ValueError for a column with decimal points in a file with decimal commas."""
    texts = column if column.dtype == object else ()
    pointed = next((cell for cell in texts if isinstance(cell, _Pointed)), None)
    if pointed is not None:
        raise ValueError(
            f"{path}: the file has decimal commas, and {str(pointed)!r} with a point; save it "
            "with one of them, and without thousands separators"
        )


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
