"""Files and folders that are written completely or not at all; JSON and CSV as text.

Everything is written under a temporary name and then renamed. A reader never finds a
partial file, and an interrupted run leaves none.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import importlib.util
import inspect
import io
import json
import math
import os
import re
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import safetensors.numpy

from .description import told

_T = TypeVar("_T")

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None
try:
    import msvcrt
except ImportError:  # everywhere else
    msvcrt = None


def csv_text(columns: Mapping[str, Any]) -> str:
    """Columns of numbers as CSV text; every number is read back exactly."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    rows = zip(*(np.asarray(v, float).tolist() for v in columns.values()), strict=True)
    writer.writerows([repr(value) for value in row] for row in rows)
    return buffer.getvalue()


def json_ready(value: Any) -> Any:
    """A copy with plain types; a number that is not finite becomes None."""
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
    """A name as a folder name: letters, digits and underscores."""
    return re.sub(r"\W+", "_", name).strip("_")


def write_json(path: Path, value: Any) -> None:
    """Writes `value` as JSON, completely or not at all."""
    # Half a surrogate pair, as in a file name that is not UTF-8, is written as JSON escapes it.
    write_bytes(path, (json_text(value) + "\n").encode(errors="backslashreplace"))


def read_json(path: Path, *keys: str, advice: str = "") -> dict[str, Any]:
    """Content of a JSON file of this package, an object with these keys.

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
    """A copy of JSON data in which None becomes NaN."""
    if isinstance(value, dict):
        return {key: numbers_of(part) for key, part in value.items()}
    if isinstance(value, list):
        return [numbers_of(part) for part in value]
    return math.nan if value is None else value


def damaged(path: Path, advice: str = "") -> ValueError:
    """The error for a damaged file, with advice."""
    return ValueError(f"{path} is damaged" + f"; {advice}" * bool(advice))


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file, completely or not at all.

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
        os.chmod(name, 0o644)  # mkstemp makes files that other users cannot read
        os.replace(name, path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        Path(name).unlink(missing_ok=True)


def write_with_files(path: Path, content: bytes, folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes a file and a folder beside it, both completely or not at all.

    A folder of this name is replaced; without files there is none.

    Raises:
        ValueError: where they cannot be written.
    """
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as unfinished:
            new, old = Path(unfinished, "new"), Path(unfinished, "old")
            new.mkdir()
            for name, part in files.items():
                (new / name).write_bytes(part)
            (new.parent / path.name).write_bytes(content)
            if folder.exists():
                folder.rename(old)
            if files:
                new.rename(folder)
            os.replace(new.parent / path.name, path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror})") from None


def require_folder(path: Path) -> None:
    """Raises ValueError where the folder of a file does not exist."""
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist")


def require_new_file(path: Path, overwrite: bool) -> None:
    """Raises ValueError, before anything is computed, where a file may not be written."""
    require_folder(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder; choose another name")
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists; choose another name or add --overwrite")


def require_unlocked(path: Path) -> None:
    """Raises ValueError where another process records into a file."""
    if is_locked(path):
        raise ValueError(f"{path}: another process records into this file")


def is_locked(path: Path) -> bool:
    """Whether another process holds the lock of a file; not where there is no file."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        return not took_lock(file)
    return False


def require_free_run_folder(path: Path, overwrite: bool, kind: str = "") -> None:
    """Raises ValueError where a run folder may not be written at `path`.

    Args:
        path: of the folder.
        overwrite: whether a run folder there is replaced.
        kind: of that run, as its marker has it ("excite study"); default any.
    """
    for parent in path.absolute().parents:
        if parent.exists():
            if not parent.is_dir():
                raise ValueError(f"{path}: {parent} is a file, not a folder")
            break
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not (path / "run.json").is_file():
        raise ValueError(f"{path} exists and is no run folder; choose another name")
    if kind:
        marker = read_json(path / "run.json", advice="choose another name, or delete the folder")
        found = str(marker.get("kind", ""))
        if found != kind:
            name = found.removeprefix("excite ")
            told = f"another kind of run ({name})" if found else "a run of an unknown kind"
            raise ValueError(f"{path} holds {told}; choose another name")
    if not overwrite:
        raise ValueError(f"{path} holds a run; choose another name or add --overwrite")


@contextlib.contextmanager
def new_run_folder(
    path: Path, overwrite: bool = False, kind: str = "", own: str = ""
) -> Iterator[Path]:
    """A folder to fill; it appears at `path` when everything in it is written.

    Args:
        path: of the folder.
        overwrite: whether a run folder there is replaced.
        kind: see `require_free_run_folder`.
        own: regular expression of the names of files of such a run: others, and all folders, are
            kept; default nothing is.
    """
    require_free_run_folder(path, overwrite, kind)
    path = path.resolve()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror})") from None
    try:
        yield unfinished
        unfinished.chmod(0o755)
        if path.exists():
            _replace(path, unfinished, own)
        else:
            unfinished.rename(path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _replace(path: Path, by: Path, own: str) -> None:
    """Puts a folder in the place of another one; nothing is lost where that fails."""
    aside = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    before = aside / path.name
    try:
        path.rename(before)
        by.rename(path)
        for other in before.iterdir():
            if own and (other.is_dir() or not re.fullmatch(own, other.name)):
                other.rename(path / other.name)
    except OSError as error:
        if before.exists() and not path.exists():
            before.rename(path)
        where = f"; what it held is in {before}" if before.exists() else ""
        raise ValueError(f"{path}: cannot be replaced ({error.strerror}){where}") from None
    shutil.rmtree(aside, ignore_errors=True)


_LOCKED_BYTE = 2**30  # beyond the end of a file: on Windows, nobody can read a locked byte


def took_lock(file: IO[Any]) -> bool:
    """Locks an open file until it is closed, or its process ends; whether that succeeded."""
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        elif msvcrt is not None:
            place = file.tell()
            file.seek(_LOCKED_BYTE)
            try:
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            finally:
                file.seek(place)
    except OSError:
        return False
    return True


@contextlib.contextmanager
def locked_folder(folder: Path, what: str, markers: Collection[str] = ()) -> Iterator[None]:
    """The folder, created if missing, for one process at a time; ValueError otherwise.

    Where that fails, a new folder that holds no file but the markers is removed.

    Args:
        what: is done in it.
        markers: names of files that say what is done, and hold nothing of its result.
    """
    is_new = not folder.exists()
    if folder.is_file():
        raise ValueError(f"{folder} exists and is no run folder; choose another name")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / ".lock").open("w")
    except OSError as error:
        raise ValueError(f"{folder}: cannot be written ({error.strerror})") from None
    with lock:
        if not took_lock(lock):
            raise ValueError(f"{folder}: another process is working on {what}")
        try:
            yield
        except BaseException:
            if is_new and holds_only(folder, markers):
                shutil.rmtree(folder, ignore_errors=True)
            raise


def holds_only(folder: Path, names: Collection[str]) -> bool:
    """Whether all files of a folder and those in it have one of these names, or are its lock."""
    return {path.name for path in folder.rglob("*") if not path.is_dir()} <= {".lock", *names}


def is_class_word(name: str) -> bool:
    """Whether a name is `path/to/file.py:ClassName`, or that of a function."""
    return name.rpartition(":")[0].endswith(".py")


def made_at(name: str, base: type[_T], kind: str) -> _T:
    """An object of the class `path/to/file.py:ClassName`, made without arguments.

    Raises:
        ValueError: as `class_at`, and for a class that needs arguments or cannot be made.
    """
    path, _, word = name.rpartition(":")
    made_from = class_at(Path(path), word, base, kind)
    try:
        return made_from()
    except Exception as error:
        raise ValueError(f"{kind} {name} cannot be made: {told(error)}") from error


def class_at(path: Path, word: str, base: type, kind: str) -> Any:
    """A class derived from `base` in a user's file. Importing the file runs its code.

    Args:
        word: the class's name; an empty one is an error that names the classes of the file.
        kind: what such a class is called in a message.

    Raises:
        ValueError: for a file that cannot be imported, or without such a class.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    module = module_at(path)
    found = getattr(module, word, None)
    if isinstance(found, type) and issubclass(found, base):
        return found
    own = [
        name
        for name, part in vars(module).items()
        if isinstance(part, type) and issubclass(part, base) and part.__module__ == module.__name__
    ]
    if not word:
        words = " or ".join(f"{path}:{name}" for name in own or ["ClassName"])
        raise ValueError(f"{path} is a file: name the {kind} in it as {words}")
    if isinstance(found, type):
        raise ValueError(f"{word} in {path} is no {kind}: it is not derived from {base.__name__}")
    raise ValueError(f"{path} has no {kind} class {word!r}; it has {', '.join(own) or 'none'}")


def function_at(path: Path, word: str) -> Callable[..., Any]:
    """A function in a user's file. Importing the file runs its code.

    Raises:
        ValueError: for a file that cannot be imported, or without such a function.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    module = module_at(path)
    found = getattr(module, word, None)
    if callable(found) and not isinstance(found, type):
        return found
    functions = [n for n, part in vars(module).items() if inspect.isfunction(part)]
    own = [n for n in functions if getattr(module, n).__module__ == module.__name__]
    raise ValueError(f"{path} has no function {word!r}; it has {', '.join(own) or 'none'}")


def module_at(path: Path) -> Any:
    """The module in a user's file, whose code is run; ValueError where it cannot be imported.

    It is run again when the file itself has changed, not what it reads: programs compiled for its
    classes serve as long as these are the same. No compiled code is written beside the file.
    """
    name, place = f"excite_file_{path.stem}", path.resolve()
    try:
        source = place.read_bytes()
    except OSError:
        source = b""  # the import says why
    known = sys.modules.get(name)
    if known is not None and getattr(known, _SOURCE, None) == (place, source):
        return known
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Equinox looks up a class's module by name
    writes_nothing, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        spec.loader.exec_module(module)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # also sys.exit
        raise ValueError(f"{path} cannot be imported: {told(error)}") from error
    finally:
        sys.dont_write_bytecode = writes_nothing
    setattr(module, _SOURCE, (place, source))
    return module


_SOURCE = "_excite_source"


_NUM_HEADER_BYTES = 8  # a safetensors file begins with the length of its JSON header
_ABOUT = "__metadata__"  # texts by name in this header
_OLD = {"format", "data"}  # such texts of files that were written without a checksum


def tensors_to_bytes(
    tensors: Mapping[str, np.ndarray], file_format: str, data: Mapping[str, Any]
) -> bytes:
    """Tensors and JSON-ready data as the content of one safetensors file, with a checksum."""
    arrays = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
    metadata = {"format": file_format, "data": json_text(data)}
    header, rest = _split(safetensors.numpy.save(arrays, metadata=metadata))
    return with_checksum(_packed(json.loads(header), rest))


def with_checksum(content: bytes) -> bytes:
    """A safetensors file with its SHA-256 in the header: that of the content without it."""
    header, rest = _split(content)
    about = json.loads(header)
    about[_ABOUT].pop("sha256", None)
    about[_ABOUT]["sha256"] = hashlib.sha256(_packed(about, rest)).hexdigest()
    return _packed(about, rest)


def checksum_of(content: bytes) -> str | None:
    """The checksum in a file's header, None where it has none."""
    return (json.loads(_split(content)[0]).get(_ABOUT) or {}).get("sha256")


def _split(content: bytes) -> tuple[bytes, bytes]:
    """Header and tensors of a valid safetensors file."""
    end = _NUM_HEADER_BYTES + int.from_bytes(content[:_NUM_HEADER_BYTES], "little")
    return content[_NUM_HEADER_BYTES:end], content[end:]


def _packed(header: Mapping[str, Any], rest: bytes) -> bytes:
    """Their file. The library's order of metadata varies; equal policies give equal files."""
    text = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _NUM_HEADER_BYTES)
    return len(text).to_bytes(_NUM_HEADER_BYTES, "little") + text + rest


def tensors_from_bytes(
    content: bytes, file_format: str, where: str
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and data written by `tensors_to_bytes`.

    A file of an older version, which has no checksum, is read with a warning.

    Raises:
        ValueError: one sentence for content that is truncated, changed, or of another format.
    """
    kind = file_format.rpartition(" ")[0]
    if not content:
        raise ValueError(f"{where}: truncated, or no {kind} file (it is empty)")
    try:
        tensors = safetensors.numpy.load(content)
        metadata = json.loads(_split(content)[0]).get(_ABOUT) or {}
        found = metadata.get("format", "none")
        if found != file_format:
            raise ValueError(f"{where}: format {found!r}; this version reads {file_format!r} files")
        is_old = metadata.keys() == _OLD
        # The whole content is compared: a bit that changes no meaning is found as well.
        if metadata.keys() > _OLD and content != with_checksum(content):
            raise ValueError(f"{where}: damaged: its content does not match its checksum")
        data = json.loads(metadata["data"])
        if not isinstance(data, dict):
            raise TypeError("its data are not a JSON object")
    except (
        safetensors.SafetensorError, KeyError, TypeError, RecursionError, json.JSONDecodeError
    ) as error:  # fmt: skip
        raise ValueError(f"{where}: truncated, or no {kind} file ({error})") from None
    if is_old:
        warnings.warn(
            f"{where}: has no checksum, so that damage is not seen; saved again it has one",
            stacklevel=3,
        )
    return tensors, data
