"""Read MDF files (versions 3 and 4): channels by name, or by `group:name` if several have that name."""

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.extras import import_extra, library_errors
from driftjax.logs.series import Series, similar_names

KIND = "MDF file"
UNFINISHED = b"UnFinMF "
REMEDY = "write it again, or export the measurement again"


def mdf_channels(path: Path) -> dict[str, str]:
    """Return the unit of every channel that is not the time stamps of its group."""
    with _opened(path) as mdf:
        places = {name: _values(mdf, places) for name, places in mdf.channels_db.items()}
        with library_errors(path, KIND, REMEDY):
            return {name: mdf.get_channel_unit(name, *located[0]) or "" for name, located in places.items() if located}


def mdf_series(path: Path, names: Iterable[str]) -> dict[str, Series]:
    """Return the channels `names`; time stamps count from the start of the measurement."""
    with _opened(path) as mdf:
        return {name: _series(path, mdf, name) for name in names}


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    asammdf = import_extra(path, f"an {KIND}", "mdf", "asammdf")
    logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # it prints its errors besides raising them
    with path.open("rb") as stream:
        if stream.read(len(UNFINISHED)) == UNFINISHED:
            raise BadInput(f"{path}: the recorder did not finish the {KIND}; finalise it with its tool or asammdf.")
        with library_errors(path, KIND, REMEDY):
            asammdf.blocks.utils.count_channel_groups(stream)  # where this fails, MDF would also print a traceback
            stream.seek(0)
            mdf = asammdf.MDF(stream)  # given the path, it would do so wherever it fails
        with mdf:
            yield mdf


def _values(mdf: Any, places: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return those `places` (group, channel) that are not the time stamps of their group."""
    return [(group, channel) for group, channel in places if mdf.masters_db.get(group) != channel]


def _series(path: Path, mdf: Any, name: str) -> Series:
    group, channel = _place(path, mdf, name)
    with library_errors(path, KIND, REMEDY):
        signal = mdf.get(group=group, index=channel, raw=True).physical(ignore_value2text_conversions=True)
    samples = signal.samples
    if samples.dtype.kind not in "biuf" or samples.ndim != 1:
        what = "text" if samples.dtype.kind in "SUO" else "several values at a time"
        raise BadInput(f"{path}: channel '{name}' holds {what}; map a channel that is one number at a time.")
    return Series(f"{_group(mdf, group)}:{signal.name}", np.asarray(signal.timestamps, float), samples.astype(float))


def _place(path: Path, mdf: Any, name: str) -> tuple[int, int]:
    """Return group and number of the channel named `name`, `group name:name` or `group number:name`."""
    places = _values(mdf, mdf.channels_db.get(name, ()))
    if not places and ":" in name:
        group, _, own = name.partition(":")
        places = [(i, k) for i, k in _values(mdf, mdf.channels_db.get(own, ())) if group in (str(i), _group(mdf, i))]
    if not places:
        raise BadInput(
            f"{path}: has no channel '{name}'; it has {similar_names(name, mdf.channels_db)}; correct the column map."
        )
    if len(places) > 1:
        own = mdf.groups[places[0][0]].channels[places[0][1]].name
        choices = ", ".join(f"'{i}:{own}' ({_group(mdf, i)})" for i, _ in places)
        raise BadInput(f"{path}: channel '{name}' is there {len(places)} times; write one of {choices}.")
    return places[0]


def _group(mdf: Any, number: int) -> str:
    """Return the name of a group of channels; its number if it has none, as in MDF3."""
    return getattr(mdf.groups[number].channel_group, "acq_name", "") or str(number)
