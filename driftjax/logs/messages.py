"""Messages of ROS bags and MCAP files as columns named `topic.field.subfield` or `topic.list[2]`."""

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.columns import Stamps
from driftjax.logs.fields import ABSENT, QUATERNION, get_field, is_list, is_scalar, message_fields
from driftjax.logs.series import Series, similar_names
from driftjax.logs.stamps import header_stamp, message_times

MOST_ITEMS = 8  # of a list; a longer one is no set of channels


class Message(NamedTuple):
    """One decoded message."""

    topic: str
    received: int
    """Time of receipt [ns]."""
    content: Any
    """A dict of JSON, a dataclass of ROS or a protobuf message."""


class ColumnPath(NamedTuple):
    """Path of a column's values within the messages of a topic."""

    column: str
    topic: str
    steps: tuple[str | int, ...]
    """Fields by name and items of lists by number, from the outside in."""


def read_series(
    path: Path,
    names: Iterable[str],
    topics: Collection[str],
    read: Callable[[Collection[str]], Iterable[Message]],
    stamps: Stamps,
) -> dict[str, Series]:
    """Return the columns `names`; `read` yields the messages of some of the recording's `topics`."""
    places = defaultdict[str, list[ColumnPath]](list)
    for name in names:
        place = _place(path, name, topics)
        places[place.topic].append(place)
    first = dict[str, Any]()
    received, stamped = defaultdict[str, list[int]](list), defaultdict[str, list[int | None]](list)
    values = defaultdict[str, list[Any]](list)
    for topic, time, content in read(places.keys()):
        first.setdefault(topic, content)
        received[topic].append(time)
        stamped[topic].append(header_stamp(content))
        for place in places[topic]:
            values[place.column].append(_value(path, place, content))
    for topic, group in places.items():
        if topic not in first:
            raise BadInput(f"{path}: topic '{topic}' has no messages; record it or correct the column map.")
        for place in group:
            if all(value is ABSENT for value in values[place.column]):
                raise _no_field(path, place, first[topic])
    t = message_times(path, received, stamped, stamps)
    return {
        place.column: Series(topic, t[topic], _array(values[place.column]))
        for topic, group in places.items()
        for place in group
    }


def number_columns(topic: str, content: Any) -> list[str]:
    """Return the names of all columns that a message of `topic` holds numbers for; its header is left out."""
    if is_scalar(content):
        return [topic]
    if is_list(content):
        return [name for i, part in enumerate(content[:MOST_ITEMS]) for name in number_columns(f"{topic}[{i}]", part)]
    fields = [name for name in message_fields(content) if name != "header" and not name.startswith("__")]
    if set(fields) == set(QUATERNION):
        return [f"{topic}.yaw"]
    return [column for name in fields for column in number_columns(f"{topic}.{name}", get_field(content, name))]


def _place(path: Path, name: str, topics: Collection[str]) -> ColumnPath:
    matches = [topic for topic in topics if name.startswith(f"{topic}.")]
    if not topics:
        raise BadInput(f"{path}: holds no messages; record it again.")
    if not matches:
        raise BadInput(
            f"{path}: column '{name}' names no topic there and a field of it; "
            f"write topic.field with a topic such as {similar_names(name, topics)}."
        )
    topic = max(matches, key=len)
    rest = name[len(topic) :]
    if not re.fullmatch(r"(\.[^.\[\]]+|\[\d+\])+", rest):
        raise BadInput(f"{path}: column '{name}' is no topic.field; write it as in '{topic}.field.list[0]'.")
    steps = re.findall(r"\[(\d+)\]|([^.\[\]]+)", rest)
    return ColumnPath(name, topic, tuple(int(number) if number else word for number, word in steps))


def _value(path: Path, place: ColumnPath, content: Any) -> Any:
    """Return the number at `place`: None if missing, `ABSENT` if only this message lacks the field."""
    part = content
    for step in place.steps:
        outside, part = part, get_field(part, step)
        if part is ABSENT and not isinstance(outside, dict) and not is_list(outside):
            raise _no_field(path, place, content)  # ROS and protobuf have the same fields in every message
        if part is None or part is ABSENT:
            return part
    if is_scalar(part):
        return part
    if isinstance(part, str | bytes):
        raise BadInput(f"{path}: column '{place.column}' holds text, such as {part!r}; map a field that is a number.")
    within = "[0]" if is_list(part) else f".{next(iter(message_fields(part)), 'field')}"
    raise BadInput(
        f"{path}: column '{place.column}' is no number but has parts; map one, such as '{place.column}{within}'."
    )


def _no_field(path: Path, place: ColumnPath, content: Any) -> BadInput:
    """Return the error for a message without a value at `place`."""
    part, name = content, place.topic
    for step in place.steps:
        outside, part = part, get_field(part, step)
        if part is ABSENT:
            there = similar_names(str(step), (one for one in message_fields(outside) if not one.startswith("__")))
            has = f"has {there}" if there else f"is a list of {len(outside)}" if is_list(outside) else "has no parts"
            return BadInput(f"{path}: column '{place.column}' is not there; '{name}' {has}; correct the column map.")
        name += f"[{step}]" if isinstance(step, int) else f".{step}"
    return BadInput(f"{path}: column '{place.column}' is in no message; correct the column map.")


def _array(values: list[Any]) -> np.ndarray:
    return np.array([np.nan if value is None or value is ABSENT else value for value in values], float)
