"""Files and folders that are written whole or not at all; JSON and CSV as text.

Everything is written under another name first and then renamed, so that a reader, or a
run that is interrupted, never leaves or meets half of anything.
"""

from __future__ import annotations

import contextlib
import csv
import importlib.util
import io
import json
import math
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np


def csv_text(columns: Mapping[str, Any]) -> str:
    """Columns of numbers as CSV text; every number is read back exactly."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    rows = zip(*(np.asarray(v, float).tolist() for v in columns.values()), strict=True)
    writer.writerows([repr(value) for value in row] for row in rows)
    return buffer.getvalue()


def json_ready(value: Any) -> Any:
    """A copy with plain types only; a number that is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(k): json_ready(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(v) for v in value]
    if isinstance(value, np.ndarray | np.generic) or hasattr(value, "__array__"):
        return json_ready(np.asarray(value).tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def json_text(value: Any) -> str:
    """`value` as one JSON object."""
    return json.dumps(json_ready(value), indent=2, ensure_ascii=False, allow_nan=False)


def folder_word(name: str) -> str:
    """A name as the word of a folder: letters, digits and underscores."""
    return re.sub(r"\W+", "_", name).strip("_")


def write_json(path: Path, value: Any) -> None:
    """Writes `value` as JSON, whole or not at all."""
    write_bytes(path, (json_text(value) + "\n").encode())


def read_json(path: Path, *keys: str, advice: str = "") -> dict[str, Any]:
    """Content of a JSON file that was written here, an object with these keys.

    Args:
        advice: what helps where the file is damaged; it ends the message.

    Raises:
        ValueError: where it cannot be read, or holds something else.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):
        raise damaged(path, advice) from None
    if not isinstance(content, dict) or not set(keys) <= content.keys():
        raise damaged(path, advice)
    return content


def read_columns(path: Path, names: Iterable[str] = (), advice: str = "") -> dict[str, np.ndarray]:
    """Columns of a CSV file that `csv_text` made, these among them.

    Raises:
        ValueError: where it cannot be read, or holds something else.
    """
    try:
        header, *rows = (line.split(",") for line in path.read_text("utf-8").splitlines())
        columns = dict(zip(header, np.array(rows, float).T, strict=True))
    except (OSError, ValueError):
        raise damaged(path, advice) from None
    if not set(names) <= columns.keys():
        raise damaged(path, advice)
    return columns


def numbers_of(value: Any) -> Any:
    """A copy of what JSON held, None become the numbers that do not exist again."""
    if isinstance(value, dict):
        return {key: numbers_of(part) for key, part in value.items()}
    if isinstance(value, list):
        return [numbers_of(part) for part in value]
    return math.nan if value is None else value


def damaged(path: Path, advice: str = "") -> ValueError:
    """The error for a file that is not as it was written, and what helps."""
    return ValueError(f"{path} is damaged" + f"; {advice}" * bool(advice))


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file, whole or not at all.

    Raises:
        ValueError: where the folder does not exist or cannot be written.
    """
    require_folder(path)
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror})") from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)  # mkstemp makes files that nobody else may read
        os.replace(name, path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        Path(name).unlink(missing_ok=True)


def require_folder(path: Path) -> None:
    """Raises ValueError where a file has no folder to be written into."""
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist")


def require_new_file(path: Path, overwrite: bool) -> None:
    """Raises ValueError, before anything is computed, where no such file may be written."""
    require_folder(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder; choose another name")
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists; choose another name or add --overwrite")


def require_free_run_folder(path: Path, overwrite: bool) -> None:
    """Raises ValueError where a run folder at `path` would hide or lose something."""
    for parent in path.absolute().parents:
        if parent.exists():
            if not parent.is_dir():
                raise ValueError(f"{path}: {parent} is a file, not a folder")
            break
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not (path / "run.json").is_file():
        raise ValueError(f"{path} exists and is no run folder; choose another name")
    if not overwrite:
        raise ValueError(f"{path} holds a run; choose another name or add --overwrite")


@contextlib.contextmanager
def new_run_folder(path: Path, overwrite: bool = False) -> Iterator[Path]:
    """A folder to fill, which appears at `path` only when everything in it is written."""
    require_free_run_folder(path, overwrite)
    path = path.absolute()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror})") from None
    try:
        yield unfinished
        unfinished.chmod(0o755)
        if path.exists():
            shutil.rmtree(path)
        unfinished.rename(path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def class_at(path: Path, word: str, base: type, kind: str) -> Any:
    """A class derived from `base` in a user's file, which is run.

    Args:
        kind: what such a class is called in a message.

    Raises:
        ValueError: for a file that cannot be imported, or without such a class.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    found = getattr(_module_at(path), word, None)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ValueError(f"{path} has no {kind} class {word!r}")
    return found


def _module_at(path: Path) -> Any:
    name = f"excite_file_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Equinox looks a class's module up by name
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{path} cannot be imported: {type(error).__name__}: {error}") from error
    return module


def text_columns(path: Path) -> dict[str, list[str]]:
    """Columns of a CSV file that anybody may have written, by name, still as text.

    Raises:
        ValueError: one sentence for a file that is no such table, or may be truncated.
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
    """The delimiter of a CSV file, and its rows, one or more, as they are written."""
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
        # A number cut in half is still a number: only the line's end shows that it is whole.
        raise ValueError(
            f"{path}: line {len(lines)} does not end with a line break; is the file truncated? "
            "(add one if it is complete)"
        )
    return delimiter, rows


def _delimiter(first: list[str]) -> str:
    """What splits the first two lines alike; names and numbers may hold commas."""
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
