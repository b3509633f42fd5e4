"""Topics of a robot's log as columns: MCAP files and ROS 2 bags.

A column is named by topic and field, such as `/joint_states.position[0]`, or with the name that
the message gives to the entry, `/joint_states.position[elbow]`. All columns share one time: an
input keeps its last value until the next message, and an output is NaN between its messages.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import re
from array import array
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np

from .damage import MAX_UNPACKED, damage_reported, require_size

BAG_ENDINGS = (".mcap", ".db3")
TIMES = ("time", "log_time")
"""Time from the messages' headers, and the time at which they were recorded."""
_ADVICE = "; `mcap recover` or `ros2 bag reindex` mend a recording that was cut off"
_STEPS = re.compile(r"\.([^.\[\]]+)|\[([^\[\]]+)\]")
_MOST_ENTRIES, _DEEPEST = 36, 8  # of arrays and of nested fields that are listed
_LARGE = 1e6  # of a quaternion, which has the length 1

_Message = tuple[str, int, Any]  # topic, time of recording [ns], content; None if not understood


def is_bag(path: Path) -> bool:
    """Whether a path is an MCAP file or a ROS 2 bag, which may be a folder."""
    return path.suffix.lower() in BAG_ENDINGS or path.is_dir()


def read_bag(
    path: Path, wanted: Collection[str] | None = None, held: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """The columns of a bag, with its times as dates; those that are not wanted are empty.

    The rows run from the first to the last output. They begin when all inputs are known.

    Args:
        path: the file or folder.
        wanted: columns to read, among them `time` or `log_time`; default all, with `time`.
        held: those that are inputs.

    Raises:
        ValueError: one sentence for a bag that cannot be read, times of a topic that do not
            increase, and topics whose times have nothing in common.
    """
    topics = _topics(path, wanted)
    fields = [field for topic in topics for field in topic.fields]
    read = [topic for topic in topics if topic.found]
    if wanted is None:
        return _joined(path, read, "time", held)
    time = next((name for name in wanted if name in TIMES), "time")
    return dict.fromkeys((*TIMES, *sorted(fields)), np.empty(0)) | _joined(path, read, time, held)


def columns_of_bag(path: Path) -> dict[str, int]:
    """The columns of a bag, and the number of messages that each has.

    Raises:
        ValueError: one sentence for a bag that cannot be read.
    """
    topics = _topics(path, None)
    counts = {name: len(topic.log_times) for topic in topics for name in topic.found}
    return {"time": max(counts.values(), default=0), **counts}


def _topics(path: Path, wanted: Collection[str] | None) -> list[_Topic]:
    """The topics of a bag, with the columns that are wanted, default all."""
    topics: dict[str, _Topic] = {}

    def is_read(name: str) -> bool:
        return name not in topics or bool(topics[name].columns)

    size = 0
    for name, log_time, message in _messages(path, is_read):
        if name not in topics:
            topics[name] = _Topic(name, _fields(message, name), wanted)
        topics[name].add(path, log_time, message)
        size += topics[name].width
        require_size(path, size)
    fields = [field for topic in topics.values() for field in topic.fields]
    if not fields:
        raise ValueError(
            f"{path}: no topic has numbers that can be read; it has {', '.join(topics) or 'none'}, "
            "and messages in CDR (ROS 2) and JSON can be read"
        )
    return [*topics.values()]


class _Topic:
    """The columns of one topic, with the times of its messages [ns]."""

    def __init__(self, name: str, fields: list[str], wanted: Collection[str] | None) -> None:
        chosen = fields if wanted is None else [w for w in wanted if _is_of(w, name)]
        self.name, self.fields = name, fields
        self.columns = {column: _Column(column, name) for column in chosen}
        self.width = 8 * (2 + len(chosen))  # bytes of a message
        self.log_times, self.stamps = array("q"), array("q")

    def add(self, path: Path, log_time: int, message: Any) -> None:
        if self.columns:
            self.log_times.append(min(log_time, 2**63 - 1))
            self.stamps.append(_stamp(message))
        for column in self.columns.values():
            column.add(path, message)

    @property
    def found(self) -> dict[str, np.ndarray]:
        """The columns that at least one message has."""
        return {n: np.array(c.cells) for n, c in self.columns.items() if c.is_found}

    def times(self, path: Path, kind: str) -> np.ndarray:
        """When the messages were made, or recorded where their headers do not tell or by `kind`."""
        has_stamps = kind == "time" and any(self.stamps)
        times = np.array(self.stamps if has_stamps else self.log_times)
        bad = np.flatnonzero(np.diff(times) <= 0)
        if bad.size:
            k = int(bad[0])
            what = "is there twice" if times[k] == times[k + 1] else "goes backwards"
            clock, mends = "log_time", ""
            if has_stamps:
                clock, mends = "header.stamp", "; --column time=log_time takes that of recording"
            raise ValueError(
                f"{path}: the time of {self.name!r} ({clock}) {what}: message {k + 1} is at "
                f"{times[k] / 1e9:.9f} s, message {k + 2} at {times[k + 1] / 1e9:.9f} s{mends}"
            )
        return times


class _Column:
    """The values of one field, NaN in messages without it."""

    def __init__(self, name: str, topic: str) -> None:
        self.name, self.cells, self.is_found = name, array("d"), False
        self._steps = _STEPS.findall(name[len(topic) :])
        self._entry: str | None = None

    def add(self, path: Path, message: Any) -> None:
        value, around = message, None
        for field, entry in self._steps:
            around, holder = value, around
            value = _part(value, field) if field else self._entry_of(path, value, entry, holder)
        if value is None:
            self.cells.append(np.nan)
            return
        if parts := _fields(value, self.name) if not _is_number(value) else ():
            raise ValueError(
                f"{path}: {self.name!r} is not one number; name one of {', '.join(parts[:7])}"
            )
        self.is_found = True
        try:
            self.cells.append(float(value))
        except (TypeError, ValueError, OverflowError):
            raise ValueError(
                f"{path}: message {len(self.cells) + 1} of {self.name!r} is {str(value)[:99]!r}, "
                "not a number"
            ) from None

    def _entry_of(self, path: Path, values: Any, entry: str, holder: Any) -> Any:
        """An entry by its number or its name; the numbers may not change their meaning."""
        names = _part(holder, "name")
        names = names if isinstance(names, list) else []
        if not entry.isdecimal():
            return _at(values, names.index(entry)) if entry in names else None
        name = _at(names, int(entry))
        self._entry = name if self._entry is None else self._entry
        if names and name != self._entry:
            raise ValueError(
                f"{path}: entry {entry} of {self.name!r} is {self._entry!r}, and in message "
                f"{len(self.cells) + 1} {name!r}; name it, "
                f"{self.name.removesuffix(f'[{entry}]')}[{self._entry}]"
            )
        return _at(values, int(entry))


def _is_of(column: str, topic: str) -> bool:
    return column == topic or column.startswith((f"{topic}.", f"{topic}["))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number | np.bool_)


def _at(values: Any, index: int) -> Any:
    """An entry of a list or array; None where there is none."""
    return values[index] if isinstance(values, list | np.ndarray) and index < len(values) else None


def _part(value: Any, name: str) -> Any:
    """A field of a message or JSON object; None where it does not have it."""
    return _parts(value).get(name)


def _parts(value: Any) -> dict[str, Any]:
    """The fields of a message or JSON object, of a quaternion also its angles [rad]."""
    parts = value
    if dataclasses.is_dataclass(value):
        parts = {name: part for name, part in vars(value).items() if name[0] != "_"}
    if not isinstance(parts, dict):
        return {}
    is_quaternion = parts.keys() == set("wxyz") and all(
        _is_number(part) and abs(part) < _LARGE for part in parts.values()
    )
    return parts | _angles(**parts) if is_quaternion else parts


def _angles(w: float, x: float, y: float, z: float) -> dict[str, float]:
    """Turns about z, then the new y, then the new x, of a unit quaternion [rad]."""
    return {
        "roll": math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        "pitch": math.asin(min(1.0, max(-1.0, 2 * (w * y - z * x)))),
        "yaw": math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    }


def _fields(value: Any, name: str, depth: int = 0) -> list[str]:
    """Names of the numbers in a message; those of its header and of long arrays are left out."""
    if _is_number(value):
        return [name]
    if depth == _DEEPEST:
        return []
    parts = {f".{n}": part for n, part in _parts(value).items() if depth or n != "header"}
    if isinstance(value, list | np.ndarray) and len(value) <= _MOST_ENTRIES:
        parts = {f"[{i}]": part for i, part in enumerate(value)}
    return [field for n, part in parts.items() for field in _fields(part, name + n, depth + 1)]


def _stamp(message: Any) -> int:
    """Nanoseconds of `header.stamp`; 0 where there is none."""
    stamp = _parts(_part(_part(message, "header"), "stamp"))
    seconds, rest = (
        next((stamp[name] for name in names if isinstance(stamp.get(name), int)), 0)
        for names in (("sec", "secs"), ("nanosec", "nsec", "nsecs"))
    )
    total = seconds * 10**9 + rest
    return total if 0 <= total < 2**63 else 0


def _joined(
    path: Path, topics: Sequence[_Topic], time: str, held: Collection[str]
) -> dict[str, np.ndarray]:
    """The columns of all topics at the instants of any of them."""
    times = [topic.times(path, time) for topic in topics]
    _require_one_clock(path, [topic.name for topic in topics], times)
    instants = np.unique(np.concatenate([np.empty(0, np.int64), *times]))
    require_size(path, 8 * len(instants) * sum(len(topic.found) for topic in topics))
    columns: dict[str, np.ndarray] = {}
    for topic, own in zip(topics, times, strict=True):
        for name, values in topic.found.items():
            column = np.full(len(instants), np.nan)
            column[np.searchsorted(instants, own)] = values
            columns[name] = _held(column) if name in held else column
    inputs, outputs = (
        [np.isfinite(column) for name, column in columns.items() if (name in held) is is_held]
        for is_held in (True, False)
    )
    rows = np.flatnonzero(np.logical_and.reduce(inputs)) if inputs else np.arange(len(instants))
    if outputs and rows.size:
        measured = rows[np.logical_or.reduce(outputs)[rows]]
        if not measured.size:
            raise ValueError(
                f"{path}: no output is measured after the first value of every input; the topics "
                f"are {', '.join(topic.name for topic in topics)}"
            )
        rows = np.arange(measured[0], measured[-1] + 1)
    dates = instants[rows].astype("datetime64[ns]")
    return {time: dates, **{name: column[rows] for name, column in columns.items()}}


def _held(column: np.ndarray) -> np.ndarray:
    """Every value until the next one; NaN before the first."""
    latest = np.where(np.isfinite(column), np.arange(len(column)), 0)
    return column[np.maximum.accumulate(latest)]


def _require_one_clock(path: Path, names: Sequence[str], times: Sequence[np.ndarray]) -> None:
    """Raises ValueError where one topic ends before another begins, as with two clocks."""
    for (a, one), (b, other) in combinations(zip(names, times, strict=True), 2):
        if min(len(one), len(other)) > 1 and (one[-1] < other[0] or other[-1] < one[0]):
            spans = (f"{x[0] / 1e9:.3f} to {x[-1] / 1e9:.3f} s" for x in (one, other))
            raise ValueError(
                f"{path}: {a!r} runs from {next(spans)} and {b!r} from {next(spans)}; are these "
                "two clocks? --column time=log_time takes that of the recording for all"
            )


# Files


def _messages(path: Path, is_read: Callable[[str], bool]) -> Iterator[_Message]:
    """Every message of the topics to read, in the order of each topic.

    Args:
        path: the file or folder.
        is_read: whether the content of a topic is needed.
    """
    files = sorted(path.glob("*.mcap"), key=lambda file: (len(file.name), file.name))
    for file in files if path.is_dir() else [path]:
        if file.suffix.lower() == ".mcap":
            yield from _of_mcap(file, is_read)
    if not files and path.suffix.lower() != ".mcap":
        yield from _of_rosbags(path, is_read)


def _of_mcap(path: Path, is_read: Callable[[str], bool]) -> Iterator[_Message]:
    records = _require_libraries(path).mcap.records
    channels, schemas = dict[int, Any](), dict[int, Any]()
    decoders: dict[int, Callable[[bytes], Any]] = {}
    with damage_reported(path, "MCAP", _ADVICE), path.open("rb") as file:
        for record in _records(path, file):
            if isinstance(record, records.Schema):
                schemas[record.id] = record
            elif isinstance(record, records.Channel):
                channels[record.id] = record
            elif isinstance(record, records.Message):
                channel = channels[record.channel_id]
                if not is_read(channel.topic):
                    continue
                if channel.id not in decoders:
                    schema = schemas.get(channel.schema_id)
                    decoders[channel.id] = _decoder(path, channel.message_encoding, schema)
                yield channel.topic, record.log_time, decoders[channel.id](record.data)


def _records(path: Path, file: BinaryIO) -> Iterator[Any]:
    """Records of an MCAP file, also those in its chunks, one chunk at a time in memory."""
    mcap = _require_libraries(path).mcap
    reader = mcap.stream_reader.StreamReader
    for record in reader(file, emit_chunks=True, record_size_limit=MAX_UNPACKED).records:
        if isinstance(record, mcap.records.Chunk):
            content = io.BytesIO(_unpacked(path, record))
            with contextlib.suppress(mcap.exceptions.EndOfFile):
                yield from reader(content, skip_magic=True).records
        else:
            yield record


def _unpacked(path: Path, chunk: Any) -> bytes:
    """The content of a chunk, which must be as long as it says."""
    libraries, size, content = _require_libraries(path), chunk.uncompressed_size, chunk.data
    if size > MAX_UNPACKED:
        raise ValueError(f"a chunk has {size >> 20} MiB unpacked, more than {MAX_UNPACKED >> 20}")
    if chunk.compression == "zstd":
        content = libraries.zstandard.ZstdDecompressor().stream_reader(content).read(size + 1)
    elif chunk.compression == "lz4":
        content = libraries.lz4.LZ4FrameDecompressor().decompress(content, max_length=size + 1)
    elif chunk.compression:
        raise ValueError(f"a chunk is packed with {chunk.compression[:20]!r}")
    if len(content) != size:
        raise ValueError(f"a chunk does not have the {size} bytes that it should")
    return content


def _decoder(path: Path, encoding: str, schema: Any) -> Callable[[bytes], Any]:
    """From the bytes of a message to its content; None for kinds that are not understood."""
    if encoding == "json":
        return json.loads
    typesys = _require_libraries(path).rosbags.typesys
    parsers = {"ros2msg": typesys.get_types_from_msg, "ros2idl": typesys.get_types_from_idl}
    if encoding != "cdr" or schema is None or schema.encoding not in parsers:
        return lambda data: None
    named = [schema.name] if schema.encoding == "ros2msg" else []
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    store.register(parsers[schema.encoding](schema.data.decode(), *named))
    return lambda data: store.deserialize_cdr(data, schema.name)


def _of_rosbags(path: Path, is_read: Callable[[str], bool]) -> Iterator[_Message]:
    """Messages of a bag in SQLite; its types are those of the newest ROS where it has none."""
    rosbags = _require_libraries(path).rosbags
    types = rosbags.typesys.get_typestore(rosbags.typesys.Stores.LATEST)
    with (
        damage_reported(path, "ROS 2 bag", _ADVICE),
        rosbags.highlevel.AnyReader([path], default_typestore=types) as reader,
    ):
        known = reader.typestore.fielddefs
        for connection, log_time, data in reader.messages():
            if is_read(connection.topic):
                is_known = connection.msgtype in known
                content = reader.deserialize(data, connection.msgtype) if is_known else None
                yield connection.topic, log_time, content


@dataclass(frozen=True)
class _Libraries:
    """What the extra `logs` installs for bags."""

    mcap: ModuleType
    rosbags: ModuleType
    zstandard: ModuleType
    lz4: ModuleType


def _require_libraries(path: Path) -> _Libraries:
    try:
        import lz4.frame
        import mcap.exceptions
        import mcap.records
        import mcap.stream_reader
        import rosbags.highlevel
        import rosbags.typesys
        import zstandard
    except ImportError:
        raise ValueError(
            f"{path}: MCAP files and ROS 2 bags need the extra: pip install 'excite[logs]'"
        ) from None
    return _Libraries(mcap, rosbags, zstandard, lz4.frame)
