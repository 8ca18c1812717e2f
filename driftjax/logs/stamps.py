"""Time stamps of messages: from their headers, or the times of receipt."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.columns import Stamps
from driftjax.logs.fields import ABSENT, get_field, is_scalar

SECONDS = ("sec", "secs", "seconds")
NANOSECONDS = ("nanosec", "nsec", "nsecs", "nanos")
UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # s per unit of time
PLAUSIBLE = (5e-4, 0.5)  # sample times of cars' logs [s]
APART = 1.0  # s by which header and receipt may differ from topic to topic on one clock
REMEDY = "write 'stamps: receipt' in the column map"


def header_stamp(content: Any) -> int | None:
    """Return the time stamp in `header.stamp` or `timestamp` of a message [ns], None if there is none."""
    stamp = get_field(get_field(content, "header"), "stamp")
    stamp = get_field(content, "timestamp") if stamp is ABSENT else stamp
    seconds, rest = ([get_field(stamp, name) for name in names] for names in (SECONDS, NANOSECONDS))
    seconds, rest = (next(filter(is_scalar, scalars), None) for scalars in (seconds, rest))
    return None if seconds is None or rest is None else int(seconds) * 10**9 + int(rest)


def message_times(
    path: Path, received: Mapping[str, Sequence[int]], stamped: Mapping[str, Sequence[int | None]], stamps: Stamps
) -> dict[str, np.ndarray]:
    """Return the time of every message by topic [s], from the first message on.

    Uses header stamps if `stamps` says so and the topic has them. Raises `BadInput` if the clocks then differ.
    """
    times = {topic: np.array(own, np.int64) for topic, own in received.items()}
    late = dict.fromkeys(times, 0.0)
    for topic, own in stamped.items():
        if stamps == "receipt" or all(one is None for one in own):
            continue
        if None in own or not any(own):
            raise BadInput(f"{path}: not all headers of '{topic}' hold a time stamp; {REMEDY}.")
        headers = np.array(own, np.int64)
        late[topic] = float(np.median((times[topic] - headers) / 1e9))
        times[topic] = headers
    first, last = min(late, key=late.__getitem__), max(late, key=late.__getitem__)
    if late[last] - late[first] > APART:
        raise BadInput(
            f"{path}: '{first}' was received {late[first]:.4g} s after its time stamps but '{last}' {late[last]:.4g} s "
            f"after, as if by two clocks; {REMEDY}."
        )
    start = min(own.min() for own in times.values())
    return {topic: (own - start) / 1e9 for topic, own in times.items()}


def units_of_time(times: np.ndarray) -> list[float]:
    """Return the units [s] in which the steps of `times` are as long as those of cars' logs, the longest first."""
    steps = np.diff(times)
    if not (steps > 0).any():
        return []
    middle = float(np.median(steps[steps > 0]))
    return [unit for unit in UNITS if PLAUSIBLE[0] <= unit * middle <= PLAUSIBLE[1]]
