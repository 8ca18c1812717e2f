"""Columns of a recording, each with its own time stamps."""

from collections import Counter
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.extras import printable

SHOWN = 6  # names that a message lists

T = TypeVar("T")


class Series(NamedTuple):
    """One column of a recording."""

    source: str
    """Topic or group of channels that it comes with; what comes from one source has one clock."""
    t: np.ndarray
    """Time (n,) [s]."""
    y: np.ndarray
    """Values (n,), NaN where one is missing."""


def check_series(path: Path, name: str, series: Series, fewest: int) -> None:
    """Raise `BadInput` if column `name` is too short, its time does not increase, or a value is infinite."""
    source, t, y = series
    if len(t) < fewest:
        raise BadInput(
            f"{path}: '{source}', which column '{name}' is read from, has {len(t)} samples, fewer than {fewest}; "
            "record it or correct the column map."
        )
    if (bad := np.diff(t) <= 0).any():
        i = int(np.argmax(bad)) + 1
        raise BadInput(
            f"{path}, sample {i + 1} of '{source}': its time stamp, {t[i]:.6f} s, is no later than that before; "
            "mend the recording or, of messages, take other time stamps (key 'stamps' of the column map)."
        )
    if np.isinf(y).any():
        raise BadInput(
            f"{path}, sample {np.argmax(np.isinf(y)) + 1} of '{source}': column '{name}' is infinite; "
            "leave the value out of the recording instead."
        )


def pick_channels(path: Path, names: Iterable[str], channels: Sequence[tuple[str, T]]) -> dict[str, T]:
    """Return the channels `names`; raises `BadInput` for one that is not there, or more than once."""
    there = Counter(name for name, _ in channels)
    for name in names:
        if name not in there:
            raise BadInput(
                f"{path}: has no channel '{name}'; it has {similar_names(name, there) or 'none'}; "
                "correct the column map."
            )
        if there[name] > 1:
            raise BadInput(f"{path}: channel '{name}' is there {there[name]} times; rename one in the logger.")
    by_name = dict(channels)
    return {name: by_name[name] for name in names}


def similar_names(name: str, there: Iterable[str]) -> str:
    """Return a few of the available names, most similar to `name` first."""
    names = sorted(set(there))
    return quote_names(get_close_matches(name, names, SHOWN, cutoff=0.0), len(names))


def quote_names(names: Sequence[str], num: int) -> str:
    """Return the first of `num` names, in quotes."""
    return ", ".join(f"'{printable(one)}'" for one in names[:SHOWN]) + (", ..." if num > SHOWN else "")
