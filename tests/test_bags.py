"""ROS 2 bags and MCAP files: the same record as a text file, topics of several rates, refusals."""

import math
import os
import struct
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.spatial
from bags import Messages, write
from experiments import described as plant
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter

from excite.record import columns_in, read_record, unbroken

KINDS = ("folder of mcap", "folder of db3", "mcap", "db3", "json", "json in zstd", "json in lz4")
COLUMNS = {"u": "/force.data", "y": "/joint_states.position[0]"}


def joints(position: float, names: Sequence[str] = ("elbow", "wrist")) -> dict[str, Any]:
    rest = [-1.0] * (len(names) - 1)
    return {"name": list(names), "position": [position, *rest]}


def same_instants(count: int = 20) -> tuple[Messages, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(2, count))
    times = 0.1 * np.arange(count)
    return {
        "/force": [(t, None, {"data": v}) for t, v in zip(times, u.tolist(), strict=True)],
        "/joint_states": [
            (t + 0.003, t, joints(v)) for t, v in zip(times, y.tolist(), strict=True)
        ],
    }, u, y  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_the_same_record_as_a_text_file(kind: str, tmp_path: Path):
    messages, u, y = same_instants()
    rows = zip(u.tolist(), y.tolist(), strict=True)
    text = "".join(f"{0.1 * k!r},{u!r},{y!r}\n" for k, (u, y) in enumerate(rows))
    (tmp_path / "log.csv").write_text(f"time,u,y\n{text}")
    expected = read_record(tmp_path / "log.csv", plant())
    record = read_record(write(kind, tmp_path, messages), plant(), COLUMNS)
    np.testing.assert_allclose(record.time, expected.time, atol=1e-9)
    np.testing.assert_array_equal(record.inputs, expected.inputs)
    np.testing.assert_array_equal(record.outputs, expected.outputs)


@pytest.mark.parametrize("kind", ["folder of mcap", "db3", "json"])
def test_topics_of_several_rates_are_joined(kind: str, tmp_path: Path):
    """Inputs keep their value; an output is missing between its messages."""
    messages: Messages = {
        "/force": [(t, None, {"data": v}) for t, v in ((0.05, 1.0), (0.35, 2.0), (0.95, 3.0))],
        "/joint_states": [(t, t, joints(10 * t)) for t in (0.0, 0.1, 0.2, 0.4, 0.6, 0.7)],
        "/imu": [
            (t, t, {"orientation": {"x": t, "y": 0.0, "z": 0.0, "w": 1.0}}) for t in (0.1, 0.5, 0.7)
        ],
    }
    columns = {**COLUMNS, "a": "/imu.orientation.x"}
    record = read_record(write(kind, tmp_path, messages), plant("u", "y a"), columns)
    nan = math.nan
    np.testing.assert_allclose(record.time, [0, 0.1, 0.25, 0.3, 0.4, 0.5, 0.6], atol=1e-9)
    np.testing.assert_array_equal(record.inputs[:, 0], [1, 1, 2, 2, 2, 2, 2])
    np.testing.assert_allclose(record.outputs[:, 0], [1, 2, nan, 4, nan, 6, 7])
    np.testing.assert_allclose(record.outputs[:, 1], [0.1, nan, nan, nan, 0.5, nan, 0.7])


def test_two_topics_at_almost_the_same_instants_are_one_part():
    times = np.sort(np.concatenate([0.1 * np.arange(100), 0.1 * np.arange(100) + 1e-4]))
    assert unbroken(times) == [slice(0, 200)]
    assert unbroken(np.concatenate([times, times + 60.0])) == [slice(0, 200), slice(200, 400)]


def test_a_message_is_missing_or_null(tmp_path: Path):
    """A cell of an output without a value is left out, an input keeps its last value."""
    force = [{"data": 1.0}, {"data": None}, {}, {"data": 2.0}]
    y = [{"v": [1.0, 2.0]}, {"v": [3.0]}, {"v": []}, {"v": [5, True]}]
    messages = {
        "/force": [(t, None, content) for t, content in enumerate(force)],
        "drive": [(t, None, content) for t, content in enumerate(y)],
    }
    path = write("json", tmp_path, messages)
    columns = {"u": "/force.data", "a": "drive.v[0]", "b": "drive.v[1]"}
    record = read_record(path, plant("u", "a b", dt=1.0), columns)
    np.testing.assert_array_equal(record.inputs[:, 0], [1, 1, 1, 2])
    np.testing.assert_array_equal(record.outputs.T, [[1, 3, math.nan, 5], [2, *[math.nan] * 2, 1]])


@pytest.mark.parametrize("kind", ["db3", "json"])
def test_the_time_of_recording_may_be_chosen(kind: str, tmp_path: Path):
    """Without a stamp it is taken; where headers stand still `log_time` mends it."""
    times = np.array([0.0, 0.1, 0.2, 0.4])
    unset = [(t, None, joints(t)) for t in times]
    one = plant("", "y")
    y = {"y": "/joint_states.position[0]"}
    path = write(kind, tmp_path, {"/joint_states": unset})
    np.testing.assert_allclose(read_record(path, one, y).time, times, atol=1e-9)
    stands = [(t, 1.0, joints(t)) for t in times]
    for made, word in ((1.0, "is there twice"), (0.5, "goes backwards")):
        stands[1:] = [(t, made, content) for t, _, content in stands[1:]]
        (tmp_path / word).mkdir()
        path = write(kind, tmp_path / word, {"/joint_states": stands})
        with pytest.raises(ValueError, match=rf"{word}: message 1 is at .*--column time=log_time"):
            read_record(path, one, y)
        record = read_record(path, one, {**y, "time": "log_time"})
        np.testing.assert_allclose(record.time, times, atol=1e-9)


def test_an_angle_is_that_of_the_quaternion(tmp_path: Path):
    angles = np.random.default_rng(0).uniform(-1.5, 1.5, (9, 3))
    turns = scipy.spatial.transform.Rotation.from_euler("ZYX", angles).as_quat()
    rows = [
        (0.1 * k, 0.1 * k, {"orientation": dict(zip("xyzw", turn, strict=True))})
        for k, turn in enumerate(turns.tolist())
    ]
    path = write("db3", tmp_path, {"/imu": rows})
    columns = {name: f"/imu.orientation.{name}" for name in ("yaw", "pitch", "roll")}
    record = read_record(path, plant("", "yaw pitch roll"), columns)
    np.testing.assert_allclose(record.outputs, angles, atol=1e-12)
    with pytest.raises(ValueError, match=r"is not one number; name one of /imu\.orient"):
        read_record(path, plant("", "pitch"), {"pitch": "/imu.orientation"})


def test_an_entry_is_named_where_its_number_changes(tmp_path: Path):
    """Two publishers of one topic: the arm's joints, and between them the hand's."""
    arm, hand = ("elbow", "wrist"), ("thumb",)
    rows = [(0.1 * k, None, joints(k, (arm, hand, arm[::-1])[k % 3])) for k in range(9)]
    path = write("mcap", tmp_path, {"/joint_states": rows})
    named = read_record(path, plant("", "y"), {"y": "/joint_states.position[elbow]"})
    expected = [0, math.nan, -1, 3, math.nan, -1, 6, math.nan, -1]
    np.testing.assert_array_equal(named.outputs[:, 0], expected)
    with pytest.raises(ValueError, match=r"'elbow', and in message 2 'thumb'; .*position\[elbow\]"):
        read_record(path, plant("", "y"), {"y": "/joint_states.position[0]"})
    with pytest.raises(ValueError, match=r"no column '/joint_states.position\[knee\]'"):
        read_record(path, plant("", "y"), {"y": "/joint_states.position[knee]"})


def test_all_columns_are_listed_without_those_of_long_arrays(tmp_path: Path):
    content = {"scan": [1.0] * 500, "header": {"seq": 1}, "a": {"b": 1, "text": "on"}, "c": [2, 3]}
    path = write("json", tmp_path, {"/x": [(0, None, content), (1, None, content)]})
    assert list(columns_in(path)) == ["time", "/x.a.b", "/x.c[0]", "/x.c[1]"]
    far = read_record(path, plant("", "y"), {"y": "/x.scan[499]"})
    np.testing.assert_array_equal(far.outputs[:, 0], [1, 1])


# Refusals


Y = {"y": "/x.y"}


def of(*contents: object, times: Sequence[float] | None = None) -> Messages:
    times = range(len(contents)) if times is None else times
    return {"/x": [(t, None, c) for t, c in zip(times, contents, strict=True)]}


NESTED: Any = 1.0
for _ in range(500):
    NESTED = {"a": NESTED}
REFUSED: dict[str, tuple[Messages, Mapping[str, str], dict[str, Any], str]] = {
    "no column": (
        of({"y": 1}, {"y": 1}),
        {},
        {},
        r"no column 'y'; the file has time, log_time, /x",
    ),
    "text": (of({"y": 1}, {"y": "on"}), Y, {}, "message 2 of '/x.y' is 'on', not a number"),
    "digits": (
        of({"y": 1}, b'{"y": %s}' % (b"7" * 5000)),
        Y,
        {},
        "not a readable MCAP file .*digit",
    ),
    "some digits": (of({"y": 1}, {"y": 10**400}), Y, {}, "message 2 of '/x.y' is '1000.*not a num"),
    "nested": (of({"y": NESTED}, {"y": 1}), Y, {}, "message 1 of '/x.y' is .*, not a number"),
    "nested deeply": (of(b"[" * 10**5), Y, {}, "not a readable MCAP file .*recursion"),
    "no numbers": (of({"z": "a"}), Y, {}, "no topic has numbers .* it has /x, .*CDR .* and JSON"),
    "no messages": ({"/x": []}, Y, {}, "no topic has numbers"),
    "a list": (of({"y": [1, 2]}), Y, {}, r"'/x.y' is not one number; name one of /x.y\[0\], /x.y"),
    "one message": (of({"y": 1}), Y, {}, "1 samples; at least two"),
    "dt": (of({"y": 1}, {"y": 2}), Y, {"dt": 0.1}, "--dt is for a file without time"),
    "unit of time": (of({"y": 1}, {"y": 2}), Y, {"units": {"time": "ms"}}, "leave its unit and sc"),
    "other time": (of({"y": 1}, {"y": 2}), {**Y, "time": "/x.t"}, {}, "no column '/x.t'"),
    "twice": (of({"y": 1}, {"y": 2}, times=[1, 1]), Y, {}, "is there twice: message 1"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_bag_that_cannot_be_used_is_one_short_sentence(kind: str, tmp_path: Path):
    messages, columns, options, sentence = REFUSED[kind]
    path = write("json", tmp_path, messages)
    with pytest.raises(ValueError, match=rf"log\.mcap: .*({sentence})") as error:
        read_record(path, plant("", "y"), columns, **options)
    assert "\n" not in str(error.value)
    assert len(str(error.value).replace(str(tmp_path), "")) < 400


def test_topics_on_two_clocks_are_refused(tmp_path: Path):
    messages: Messages = {
        "/force": [(t, t + 9000.0, {"data": t}) for t in (0.0, 1.0, 2.0)],
        "/x": [(t, t, {"y": t}) for t in (0.0, 1.0, 2.0)],
    }
    path, columns = write("json", tmp_path, messages), {"u": "/force.data", **Y}
    with pytest.raises(ValueError, match=r"'/force' runs from .* two clocks\? --column time=log_"):
        read_record(path, plant(), columns)
    record = read_record(path, plant(), {**columns, "time": "log_time"})
    np.testing.assert_array_equal(record.outputs, record.inputs)
    late = {**messages, "/force": [(9.0, None, {"data": 1.0})]}
    (tmp_path / "late").mkdir()
    with pytest.raises(ValueError, match="no output is measured after the first value of every"):
        read_record(write("json", tmp_path / "late", late), plant(), columns)


def test_a_value_that_was_sent_once_before_is_held(tmp_path: Path):
    messages: Messages = {
        "/force": [(0.0, None, {"data": 4.0})], "/x": [(t, None, {"y": t}) for t in (5.0, 6.0, 7.0)]
    }  # fmt: skip
    record = read_record(write("json", tmp_path, messages), plant(), {"u": "/force.data", **Y})
    np.testing.assert_array_equal(record.inputs[:, 0], [4, 4, 4])
    np.testing.assert_array_equal(record.time, [0, 1, 2])


@pytest.mark.parametrize("module", ["mcap.records", "rosbags.highlevel"])
@pytest.mark.parametrize("kind", ["folder of mcap", "folder of db3", "mcap", "db3", "json"])
def test_a_missing_extra_is_one_sentence(kind: str, module: str, tmp_path: Path, monkeypatch):
    path = write(kind, tmp_path, same_instants()[0])
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=r"need the extra: pip install 'excite\[logs\]'"):
        read_record(path, plant(), COLUMNS)


@pytest.mark.parametrize("kind", ["mcap", "db3", "json", "json in zstd", "json in lz4"])
def test_a_damaged_bag_is_one_sentence(kind: str, tmp_path: Path):
    path = write(kind, tmp_path, same_instants()[0])
    content = path.read_bytes()
    for damaged in (
        b"",
        b"time,u\n0,1\n",
        content[:40],
        content[:-60],
        content[: len(content) // 2],
    ):
        path.write_bytes(damaged)
        with pytest.raises(
            ValueError, match=r"not a readable .*cut off|no topic has numb"
        ) as error:
            read_record(path, plant(), COLUMNS)
        assert "\n" not in str(error.value)


def test_messages_that_are_not_understood_are_left_out(tmp_path: Path):
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        for topic, encoding in (("/a", "protobuf"), ("/b", "cdr")):
            schema = writer.register_schema("any", "protobuf", b"?")
            channel = writer.register_channel(topic, encoding, schema)
            writer.add_message(channel, 1, b"?", 1)
        writer.finish()
    with pytest.raises(ValueError, match=r"no topic has numbers .*; it has /a, /b, and"):
        read_record(tmp_path / "log.mcap", plant(), COLUMNS)


@pytest.mark.parametrize("packed", [CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize("lies", [False, True])
def test_a_chunk_that_unpacks_to_very_much_is_not_loaded(packed, lies: bool, tmp_path: Path):
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file, compression=packed, chunk_size=2**40, index_types=IndexType.NONE)
        writer.start()
        channel = writer.register_channel("/x", "json", 0)
        for k in range(5):
            writer.add_message(channel, k, b" " * 2**26 + b"{}", k)
        writer.finish()
    content = path.read_bytes()
    assert len(content) < 2**23
    sentence = "a chunk has 320 MiB unpacked, more than 256"
    if lies:
        with path.open("rb") as file:
            records = StreamReader(file, emit_chunks=True).records
            size = next(record.uncompressed_size for record in records if isinstance(record, Chunk))
        path.write_bytes(content.replace(struct.pack("<Q", size), struct.pack("<Q", 99)))
        sentence = "a chunk does not have the 99 bytes that it should|LZ4F_decompress failed"
    with pytest.raises(ValueError, match=sentence):
        read_record(path, plant(), COLUMNS)


def test_columns_of_very_many_messages_are_not_loaded(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("excite.record.damage.MAX_UNPACKED", 1000)
    path = write("json", tmp_path, of(*[{"y": 1}] * 50))
    with pytest.raises(ValueError, match=r"columns take .* unpacked, more than"):
        read_record(path, plant("", "y"), Y)


def test_a_folder_is_a_bag_where_it_has_its_metadata(tmp_path: Path):
    with pytest.raises(ValueError, match=r"is a folder; only files .* metadata\.yaml"):
        read_record(tmp_path, plant())
    (tmp_path / "metadata.yaml").write_text("a: [\n")
    with pytest.raises(ValueError, match="not a readable ROS 2 bag"):
        read_record(tmp_path, plant())
    os.mkfifo(tmp_path / "log.mcap")
    with pytest.raises(ValueError, match="is a pipe or a device"):
        read_record(tmp_path, plant())


def test_a_bag_in_several_files_is_one_record(tmp_path: Path):
    messages, u, y = same_instants(33)
    parts = {topic: (rows[:11], rows[11:22], rows[22:]) for topic, rows in messages.items()}
    for i, name in enumerate(("bag_2", "bag_9", "bag_10")):
        (tmp_path / name).mkdir()
        part = write("mcap", tmp_path / name, {topic: rows[i] for topic, rows in parts.items()})
        part.rename(tmp_path / f"{name}.mcap")
    (tmp_path / "all").mkdir()
    (tmp_path / "all" / "metadata.yaml").touch()
    for part in tmp_path.glob("*.mcap"):
        part.rename(tmp_path / "all" / part.name)
    record = read_record(tmp_path / "all", plant(), COLUMNS)
    np.testing.assert_array_equal(record.inputs[:, 0], u)
    np.testing.assert_array_equal(record.outputs[:, 0], y)
