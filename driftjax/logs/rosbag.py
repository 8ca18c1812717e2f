"""Read ROS bags with rosbags: ROS 1 files, and ROS 2 folders or databases with SQLite or MCAP storage."""

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

from driftjax.core import BadInput
from driftjax.logs.extras import import_extra, library_errors
from driftjax.logs.messages import Message

KIND = "ROS bag"
ROS1 = b"#ROSBAG"
REMEDY = "mend it with 'rosbag reindex' or 'ros2 bag reindex', or record it again"


def bag_topics(path: Path) -> list[str]:
    """Return the topics of the bag."""
    with library_errors(path, KIND, REMEDY), _reader(path) as reader:
        return sorted(reader.topics)


def bag_messages(path: Path, topics: Collection[str], notes: list[str]) -> Iterator[Message]:
    """Yield the messages of these topics, by time of receipt."""
    with library_errors(path, KIND, REMEDY), _reader(path) as reader:
        chosen = [one for one in reader.connections if one.topic in topics]
        decoders = {one.id: _decoder(path, one, notes) for one in chosen}
        if chosen:
            for connection, time, data in reader.messages(chosen):
                yield Message(connection.topic, time, decoders[connection.id](data))


def _reader(path: Path) -> Any:
    return _rosbags(path, "rosbag1" if is_ros1(path) else "rosbag2").Reader(path)


def is_ros1(path: Path) -> bool:
    """Return whether the bag is of ROS 1."""
    if path.is_dir():
        return False
    with path.open("rb") as stream:
        return stream.read(len(ROS1)) == ROS1


def _rosbags(path: Path, module: str) -> Any:
    return import_extra(path, f"a {KIND}", "ros", f"rosbags.{module}")


def _decoder(path: Path, connection: Any, notes: list[str]) -> Callable[[bytes], Any]:
    definition = connection.msgdef
    if definition.format.name == "MSG":
        return ros_decoder(path, definition.data, connection.msgtype, "ros1" if is_ros1(path) else "cdr")
    typesys = _rosbags(path, "typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)  # later ones write definitions into their bags
    if definition.format.name != "NONE" or connection.msgtype not in store.types:
        raise BadInput(
            f"{path}: the bag does not define the messages of '{connection.topic}', {connection.msgtype}; convert it "
            "to MCAP with 'ros2 bag convert' where this type is known."
        )
    notes.append(f"{path}: the bag does not define the messages of '{connection.topic}'; those of ROS 2 Humble hold.")
    return lambda data: store.deserialize_cdr(data, connection.msgtype)


def ros_decoder(path: Path, definition: str, name: str, encoding: str) -> Callable[[bytes], Any]:
    """Return a decoder of ROS messages of type `name` with this definition; `encoding` is ros1 or cdr (ROS 2)."""
    typesys = _rosbags(path, "typesys")
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    types = typesys.get_types_from_msg(definition, name)
    store.register(types)
    decode, full_name = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr, next(iter(types))
    return lambda data: decode(data, full_name)
