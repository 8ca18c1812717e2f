"""Fields of decoded messages: dicts of JSON, dataclasses of ROS, protobuf messages."""

from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from typing import Any

import numpy as np

QUATERNION = ("x", "y", "z", "w")
ABSENT = object()  # the message has no such field


def get_field(part: Any, step: str | int) -> Any:
    """Return field or item `step` of `part`: None if it is not set, `ABSENT` if there is no such field.

    `yaw` of a quaternion is its heading [rad].
    """
    if isinstance(step, int):
        return part[step] if is_list(part) and step < len(part) else ABSENT
    there = message_fields(part)
    if step not in there:
        return _yaw(part) if step == "yaw" and all(name in there for name in QUATERNION) else ABSENT
    if isinstance(part, dict):
        return part[step]
    unset = hasattr(part, "HasField") and there[step].has_presence and not part.HasField(step)
    return None if unset else getattr(part, step)


def message_fields(part: Any) -> Mapping[str, Any]:
    """Return the fields by name; empty if `part` is not a message."""
    if isinstance(part, dict):
        return part
    if is_dataclass(part):
        return part.__dataclass_fields__
    return part.DESCRIPTOR.fields_by_name if hasattr(part, "DESCRIPTOR") else {}


def is_list(part: Any) -> bool:
    """Return whether `part` has items by number."""
    return isinstance(part, Sequence | np.ndarray) and not isinstance(part, str | bytes)


def is_scalar(part: Any) -> bool:
    """Return whether `part` is one value; true and false count as 1 and 0."""
    return isinstance(part, bool | int | float | np.number | np.bool_)


def _yaw(quaternion: Any) -> Any:
    parts = [get_field(quaternion, name) for name in QUATERNION]
    if not all(map(is_scalar, parts)):
        return None if None in parts else ABSENT
    x, y, z, w = parts
    return None if x == y == z == w == 0 else float(heading(x, y, z, w))


def heading(x: Any, y: Any, z: Any, w: Any) -> np.ndarray:
    """Return the heading of a quaternion [rad], NaN where it is zero."""
    psi = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return np.where(np.abs(x) + np.abs(y) + np.abs(z) + np.abs(w) == 0, np.nan, psi)
