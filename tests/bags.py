"""Writes small ROS 2 bags and MCAP files."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE: Any = get_typestore(Stores.LATEST)
START = 1_700_000_000 * 10**9  # [ns]

Messages = Mapping[str, Sequence[tuple[float, float | None, Any]]]
"""By topic: the time of recording, that of the header [s], and the content as data."""


def stamp(seconds: float) -> dict[str, int]:
    nanoseconds = START + round(seconds * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def message(kind: str, content: Any, made: float | None) -> Any:
    """A message of ROS from data."""
    types = STORE.types
    instant = {"sec": 0, "nanosec": 0} if made is None else stamp(made)
    time = types["builtin_interfaces/msg/Time"](**instant)
    header = types["std_msgs/msg/Header"](time, "base")
    if kind == "std_msgs/msg/Float64":
        return types[kind](content["data"])
    if kind == "sensor_msgs/msg/JointState":
        zeros = np.zeros(len(content["position"]))
        return types[kind](header, content["name"], np.array(content["position"]), zeros, zeros)
    none = np.zeros(9)
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    orientation = quaternion(**content["orientation"])
    return types[kind](header, orientation, none, vector(0, 0, 0), none, vector(0, 0, 0), none)


TYPES = {
    "/force": "std_msgs/msg/Float64",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/imu": "sensor_msgs/msg/Imu",
}


def write_ros(folder: Path, messages: Messages, storage: StoragePlugin) -> Path:
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        for topic, rows in messages.items():
            connection = writer.add_connection(topic, TYPES[topic], typestore=STORE)
            for logged, made, content in rows:
                data = STORE.serialize_cdr(message(TYPES[topic], content, made), TYPES[topic])
                writer.write(connection, START + round(logged * 1e9), data)
    return folder


def write_json(path: Path, messages: Messages, packed: CompressionType) -> Path:
    with path.open("wb") as file:
        writer = McapWriter(file, compression=packed, chunk_size=200)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        for topic, rows in messages.items():
            channel = writer.register_channel(topic, "json", schema)
            for logged, made, content in rows:
                header = {} if made is None else {"header": {"stamp": stamp(made)}}
                time = START + round(logged * 1e9)
                is_raw = isinstance(content, bytes)
                data = content if is_raw else json.dumps({**header, **content}).encode()
                writer.add_message(channel, time, data, time)
        writer.finish()
    return path


def write(kind: str, folder: Path, messages: Messages) -> Path:
    """A bag of one kind."""
    packed = {"json in zstd": CompressionType.ZSTD, "json in lz4": CompressionType.LZ4}
    if kind.startswith("json"):
        return write_json(folder / "log.mcap", messages, packed.get(kind, CompressionType.NONE))
    storage = StoragePlugin.MCAP if "mcap" in kind else StoragePlugin.SQLITE3
    bag = write_ros(folder / "bag", messages, storage)
    return bag if kind.startswith("folder") else next(bag.glob(f"*.{kind}"))
