"""Read MoTeC log data (.ld): a chain of channel descriptions, each with its own rate and scaling.

The format is not published; its layout is the one that free readers agree on (gotzl/ldparser on GitHub, 2023).
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.series import Series, pick_channels

KIND = "MoTeC file"
MAGIC = b"\x40\0\0\0\0\0\0\0"
REMEDY = "log it again, or export it from MoTeC i2"
FIRST = 8  # where the header says at which byte the first channel is described
# previous, next, data, number of samples; count, kind, size, rate [Hz]; shift, multiplier, scale, decimals; texts
CHANNEL = struct.Struct("<IIII HHHH hhhh 32s 8s 12s")
INTEGERS, FLOATS, DOUBLES = (0, 3, 5), 7, 8  # kinds of samples
TYPES = {(kind, size): f"<i{size}" for kind in INTEGERS for size in (2, 4)}
TYPES |= {(FLOATS, 2): "<f2", (FLOATS, 4): "<f4", (DOUBLES, 8): "<f8"}


class _Channel(NamedTuple):
    """Description of one channel."""

    name: str
    unit: str
    start: int
    """Of its samples [bytes]."""
    num: int
    kind: tuple[int, int]
    rate: int
    """[Hz]"""
    shift: int
    multiplier: int
    scale: int
    decimals: int


def motec_channels(path: Path) -> dict[str, str]:
    """Return the unit of every channel."""
    return {channel.name: channel.unit for channel in _channels(path, path.read_bytes())}


def motec_series(path: Path, names: list[str]) -> dict[str, Series]:
    """Return the channels `names`; time counts from the start of the log."""
    content = path.read_bytes()
    channels = pick_channels(path, names, [(one.name, one) for one in _channels(path, content)])
    return {name: _series(path, content, one) for name, one in channels.items()}


def _channels(path: Path, content: bytes) -> list[_Channel]:
    """Return the descriptions of all channels; raises `BadInput` if they have more samples than the file can hold."""
    channels = list(_described(path, content))
    if (size := sum(one.num * one.kind[1] for one in channels)) > len(content):
        raise BadInput(f"{path}: ends before the samples of its channels do ({size} bytes of {len(content)}); "
                       f"{REMEDY}.")  # fmt: skip
    return channels


def _described(path: Path, content: bytes) -> Iterator[_Channel]:
    at, seen = struct.unpack_from("<I", content.ljust(FIRST + 4, b"\0"), FIRST)[0], set[int]()
    while at:
        if at in seen or at + CHANNEL.size > len(content):
            raise BadInput(f"{path}: is a damaged {KIND}: its list of channels leads to byte {at}; {REMEDY}.")
        seen.add(at)
        _, at, start, num, _, kind, size, rate, shift, multiplier, scale, decimals, name, _, unit = CHANNEL.unpack_from(
            content, at
        )
        yield _Channel(_text(name), _text(unit), start, num, (kind, size), rate, shift, multiplier, scale, decimals)


def _text(field: bytes) -> str:
    return field.split(b"\0")[0].decode("latin-1").strip()


def _series(path: Path, content: bytes, channel: _Channel) -> Series:
    start, num, kind = channel.start, channel.num, TYPES.get(channel.kind)
    if kind is None or not channel.rate or not channel.scale or abs(channel.decimals) > 30:
        raise BadInput(
            f"{path}: channel '{channel.name}' has samples of kind {channel.kind}, {channel.rate} Hz, scale "
            f"{channel.scale} and {channel.decimals} decimals, which cannot be read; leave it out of the column map."
        )
    if start + num * np.dtype(kind).itemsize > len(content):
        raise BadInput(f"{path}: ends before the samples of channel '{channel.name}' do; {REMEDY}.")
    with np.errstate(invalid="ignore", over="ignore"):  # of damaged samples
        raw = np.frombuffer(content, kind, num, start).astype(float)
        y = (raw / channel.scale * 10.0**-channel.decimals + channel.shift) * channel.multiplier
    return Series(f"channels at {channel.rate} Hz", np.arange(num) / channel.rate, y)
