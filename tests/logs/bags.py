"""One made-up drive, written by the libraries of each format of recording."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from asammdf import MDF, Signal
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from mcap.writer import CompressionType as CompressionType
from mcap.writer import Writer as McapWriter
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as Ros2Writer
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_typestore

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
START = 1_700_000_000_123_456_789  # ns


class Source(NamedTuple):
    """One topic, or one group of channels."""

    topic: str
    type: str
    ns: np.ndarray  # time stamps from the start on [ns]
    columns: dict[str, Any]  # by field; orientation.yaw becomes a quaternion
    late: np.ndarray | int = 0  # by which it is received [ns]
    header: bool = True

    def messages(self) -> Iterator[tuple[int, dict]]:
        """Time of receipt [ns] and content of each message."""
        for i, (ns, received) in enumerate(zip(self.ns, self.ns + self.late, strict=True)):
            content: dict = {"header": {"stamp": split(START + int(ns))}} if self.header else {}
            for name, values in self.columns.items():
                put(content, name.split("."), np.asarray(values)[i].tolist())
            yield START + int(received), content


def split(ns: int) -> dict[str, int]:
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


def put(content: dict, steps: list[str], value: Any) -> None:
    for step in steps[:-1]:
        content = content.setdefault(step, {})
    if steps[-1] == "yaw":
        content |= {"x": 0.0, "y": 0.0, "z": float(np.sin(value / 2)), "w": float(np.cos(value / 2))}
    else:
        content[steps[-1]] = value


def signals(t: np.ndarray) -> dict[str, np.ndarray]:
    """The drive at times `t` [s]; the heading passes through pi."""
    return {
        "vx": 10 + np.sin(t),
        "vy": np.sin(2 * t),
        "r": 0.5 * np.cos(t),
        "psi": 3 + 0.5 * np.sin(t),
        "x": 10 * t,
        "ay": 5 * np.cos(t),
        "delta": 0.1 * np.round(4 * np.sin(t)) / 4,
        "force": 500 * np.cos(2 * t),
    }


def drive(odom: np.ndarray, imu: np.ndarray, command: np.ndarray, late: np.ndarray | int = 0) -> list[Source]:
    """The drive as sampled at these stamps [ns]; only the IMU's messages are late."""
    a, b, c = (signals(ns / 1e9) for ns in (odom, imu, command))
    pose, twist = "pose.pose", "twist.twist.linear"
    a = {
        f"{twist}.x": a["vx"],
        f"{twist}.y": a["vy"],
        f"{pose}.position.x": a["x"],
        f"{pose}.orientation.yaw": a["psi"],
    }
    b = {"angular_velocity.z": b["r"], "linear_acceleration.y": b["ay"]}
    c = {"data": np.stack([c["delta"], c["force"]], axis=1)}
    flag = {"data": np.array([True, False])}
    return [
        Source("/odom", "nav_msgs/msg/Odometry", odom, a),
        Source("/imu", "sensor_msgs/msg/Imu", imu, b, late),
        Source("/command", "std_msgs/msg/Float64MultiArray", command, c, header=False),
        Source("/enabled", "std_msgs/msg/Bool", np.array([0, 9 * 10**9]), flag, header=False),
    ]


MESSAGE_MAP = """
columns:
  t: time
  vx: /odom.twist.twist.linear.x
  vy: /odom.twist.twist.linear.y
  psi: /odom.pose.pose.orientation.yaw
  x: /odom.pose.pose.position.x
  r: /imu.angular_velocity.z
  ay: /imu.linear_acceleration.y
  delta: /command.data[0]
Fxr_from: {column: "/command.data[1]", factor: 2}
where:
  /enabled.data: 1
"""
MDF_MAP = """
columns: {t: time, vx: vx, vy: vy, psi: psi, x: x, r: r, ay: ay, delta: delta}
Fxr_from: {column: force, factor: 2}
where: {enabled: 1}
"""


def built(store: Any, name: str, values: dict) -> Any:
    """ROS message of type `name` with these fields; 0 and empty elsewhere."""
    filled = {}
    for field, (node, kind) in store.fielddefs[name][1]:
        if node.name == "NAME":
            filled[field] = built(store, kind, values.get(field, {}))
        elif node.name == "BASE":
            filled[field] = values.get(field, "" if kind[0] == "string" else 0)
        elif kind[0][0].name == "BASE":
            filled[field] = np.array(values.get(field, [0] * kind[1]), kind[0][1][0])
        else:
            filled[field] = []
    return store.types[name](**filled)


def by_receipt(sources: list[Source]) -> list[tuple[int, Source, dict]]:
    every = [(received, source, content) for source in sources for received, content in source.messages()]
    return sorted(every, key=lambda one: one[0])


def write_ros1(path: Path, sources: list[Source]) -> Path:
    with Bag1(path) as bag:
        connections = {one.topic: bag.add_connection(one.topic, one.type, typestore=ROS1) for one in sources}
        for received, source, content in by_receipt(sources):
            data = ROS1.serialize_ros1(built(ROS1, source.type, content), source.type)
            bag.write(connections[source.topic], received, data)
    return path


def write_ros2(path: Path, sources: list[Source], storage: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    with Bag2(path, version=9, storage_plugin=storage) as bag:
        connections = {one.topic: bag.add_connection(one.topic, one.type, typestore=ROS2) for one in sources}
        for received, source, content in by_receipt(sources):
            data = ROS2.serialize_cdr(built(ROS2, source.type, content), source.type)
            bag.write(connections[source.topic], received, data)
    return path


def write_mcap_ros2(path: Path, sources: list[Source]) -> Path:
    with path.open("wb") as stream, Ros2Writer(stream) as bag:
        definition = lambda name: ROS2.generate_msgdef(name, ros_version=2)[0]
        schemas = {one.topic: bag.register_msgdef(one.type, definition(one.type)) for one in sources}
        for received, source, content in by_receipt(sources):
            bag.write_message(source.topic, schemas[source.topic], content, received)
    return path


def write_mcap_plain(
    path: Path,
    sources: list[Source],
    encodings: tuple[str, str],
    schema: Callable[[Source], bytes],
    encode: Callable[[Source, dict], bytes],
    **options: Any,
) -> Path:
    """Messages in `encodings` (of messages, of their schemas)."""
    with path.open("wb") as stream:
        bag = McapWriter(stream, **options)
        bag.start()
        channels = {}
        for one in sources:
            number = bag.register_schema(one.type.replace("/msg", ""), encodings[1], schema(one))
            channels[one.topic] = bag.register_channel(one.topic, encodings[0], number)
        for received, source, content in by_receipt(sources):
            bag.add_message(channels[source.topic], received, encode(source, content), received)
        bag.finish()
    return path


def write_mcap_ros1(path: Path, sources: list[Source]) -> Path:
    definition = lambda one: ROS1.generate_msgdef(one.type)[0].encode()
    encode = lambda one, content: bytes(ROS1.serialize_ros1(built(ROS1, one.type, content), one.type))
    return write_mcap_plain(path, sources, ("ros1", "ros1msg"), definition, encode)


def write_mcap_json(path: Path, sources: list[Source], **options: Any) -> Path:
    encode = lambda one, content: json.dumps(content).encode()
    return write_mcap_plain(path, sources, ("json", "jsonschema"), lambda one: b"{}", encode, **options)


def write_mcap_protobuf(path: Path, sources: list[Source]) -> Path:
    kinds = {one.topic: protobuf_type(one.topic[1:], next(one.messages())[1]) for one in sources}
    with path.open("wb") as stream, ProtobufWriter(stream) as bag:
        for received, source, content in by_receipt(sources):
            bag.write_message(source.topic, json_format.ParseDict(content, kinds[source.topic]()), received)
    return path


def protobuf_type(name: str, example: dict) -> Any:
    """A protobuf message with the fields of `example`."""
    kinds = {bool: "TYPE_BOOL", int: "TYPE_INT64", float: "TYPE_DOUBLE", str: "TYPE_STRING", dict: "TYPE_MESSAGE"}

    def fill(message: Any, example: dict) -> None:
        for number, (key, value) in enumerate(example.items(), start=1):
            one = value[0] if isinstance(value, list) else value
            label = "LABEL_REPEATED" if isinstance(value, list) else "LABEL_OPTIONAL"
            field = message.field.add(name=key, number=number, type=kinds[type(one)], label=label)
            if isinstance(one, dict):
                field.type_name = f"Of_{key}"
                fill(message.nested_type.add(name=field.type_name), one)

    file = descriptor_pb2.FileDescriptorProto(name=f"{name}.proto", package=name, syntax="proto3")
    fill(file.message_type.add(name="Message"), example)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{name}.Message"))


def write_mdf(path: Path, sources: list[Source], version: str = "4.10") -> Path:
    with MDF(version=version) as mdf:
        for one in sources:
            columns = {SHORT.get(name, name): np.asarray(values) for name, values in one.columns.items()}
            if one.topic == "/command":
                columns = dict(zip(("delta", "force"), columns["data"].T, strict=True))
            elif one.topic == "/enabled":
                columns = {"enabled": columns["data"].astype(np.uint8)}
            elif "psi" in columns:
                columns["psi"] = np.angle(np.exp(1j * columns["psi"]))
            mdf.append([Signal(y, one.ns / 1e9, name=name) for name, y in columns.items()], acq_name=one.topic[1:])
        mdf.save(path, overwrite=True)
    return path


SHORT = {
    "twist.twist.linear.x": "vx",
    "twist.twist.linear.y": "vy",
    "pose.pose.position.x": "x",
    "pose.pose.orientation.yaw": "psi",
    "angular_velocity.z": "r",
    "linear_acceleration.y": "ay",
}

WRITERS: dict[str, Callable[[Path, list[Source]], Path]] = {
    "ros1.bag": write_ros1,
    "ros2": write_ros2,
    "ros2_mcap": lambda path, sources: write_ros2(path, sources, StoragePlugin.MCAP),
    "ros2.mcap": write_mcap_ros2,
    "ros1.mcap": write_mcap_ros1,
    "json.mcap": write_mcap_json,
    "protobuf.mcap": write_mcap_protobuf,
    "log.mf4": write_mdf,
}
MESSAGES = [name for name in WRITERS if name != "log.mf4"]


def recorded(folder: Path, name: str, sources: list[Source]) -> tuple[Path, Path]:
    """The drive in the format of `name`, and the file of its column map."""
    columns = folder / f"{name}.yaml"
    columns.write_text(MDF_MAP if name.endswith("mf4") else MESSAGE_MAP)
    return WRITERS[name](folder / name, sources), columns
