"""Read MCAP files: messages of ROS 1 and 2, JSON and protobuf."""

import json
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

from driftjax.core import BadInput
from driftjax.logs.extras import import_extra, library_errors
from driftjax.logs.messages import Message
from driftjax.logs.rosbag import ros_decoder

KIND = "MCAP file"
REMEDY = "mend it with 'mcap recover', or record it again"
ROS = {"cdr": "ros2msg", "ros1": "ros1msg"}  # encodings of messages with those of their definitions


def mcap_topics(path: Path) -> list[str]:
    """Return the topics of the file."""
    with library_errors(path, KIND, REMEDY), path.open("rb") as stream:
        reader = _mcap(path, "mcap.reader").make_reader(stream)
        summary = reader.get_summary()
        if summary is not None:
            return sorted({channel.topic for channel in summary.channels.values()})
        return sorted({channel.topic for _, channel, _ in reader.iter_messages()})


def mcap_messages(path: Path, topics: Collection[str]) -> Iterator[Message]:
    """Yield the messages of these topics, by time of receipt."""
    decoders = dict[int, Callable[[bytes], Any]]()
    with library_errors(path, KIND, REMEDY), path.open("rb") as stream:
        reader = _mcap(path, "mcap.reader").make_reader(stream, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(topics=topics):
            if channel.id not in decoders:
                decoders[channel.id] = _decoder(path, schema, channel)
            yield Message(channel.topic, message.log_time, decoders[channel.id](message.data))


def _mcap(path: Path, module: str) -> Any:
    return import_extra(path, f"an {KIND}", "mcap", module)


def _decoder(path: Path, schema: Any, channel: Any) -> Callable[[bytes], Any]:
    encoding = channel.message_encoding
    if encoding == "json":
        return json.loads
    if encoding == "protobuf":
        return _mcap(path, "mcap_protobuf.decoder").DecoderFactory().decoder_for(encoding, schema)
    if schema is not None and encoding in ROS and schema.encoding == ROS[encoding]:
        return ros_decoder(path, schema.data.decode(), schema.name, encoding)
    described = f", described by {schema.encoding}" if schema is not None else ""
    raise BadInput(
        f"{path}: the messages of topic '{channel.topic}' are in {encoding or 'no known encoding'}{described}; "
        "those that can be read are in cdr with ros2msg, ros1 with ros1msg, json and protobuf."
    )
