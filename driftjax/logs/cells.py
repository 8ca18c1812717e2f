"""Read cells of text: numbers, times of day with or without a date, and missing values."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})  # cells that hold no value, in lower case
DATE_AND_TIME = re.compile(
    r"(\d{4})([-/._])(\d\d?)\2(\d\d?)[ T_](\d\d?)([:_.])(\d\d)\6(\d\d)(?:[.,:_](\d+))? ?(Z|UTC|[+-]\d\d:?\d\d)?"
)
CLOCK = re.compile(r"(\d\d?):(\d\d):(\d\d)(?:[.,:](\d+))?")
DAY = 86400.0  # s


def _number(cell: str) -> float:
    """Return the number in a cell; raises `ValueError` for anything else."""
    if "_" in cell:  # which Python takes for a separator of thousands
        raise ValueError(cell)
    return float(cell)


def cells_as_numbers(cells: Sequence[str]) -> tuple[np.ndarray, list[int]]:
    """Return the cells (n,) as numbers, or as seconds where the first value is a time, and the rows that are neither.

    What is missing or neither is NaN. A clock without a date goes on past midnight.
    """
    there = [(i, cell) for i, cell in enumerate(cells) if cell.strip().lower() not in MISSING]
    first = there[0][1] if there else ""
    read = _seconds if is_time(first) else _number
    values, wrong = np.full(len(cells), np.nan), []
    for i, cell in there:
        try:
            values[i] = read(cell)
        except ValueError:
            wrong.append(i)
    return (_past_midnight(values) if CLOCK.fullmatch(first.strip()) else values), wrong


def is_number(cell: str) -> bool:
    """Return whether a cell holds a finite number."""
    try:
        return bool(np.isfinite(_number(cell)))
    except ValueError:
        return False


def is_time(cell: str) -> bool:
    """Return whether a cell holds a time of day, with or without a date before it."""
    return bool(DATE_AND_TIME.fullmatch(cell.strip()) or CLOCK.fullmatch(cell.strip()))


def _seconds(cell: str) -> float:
    """Return a time of day in seconds, with a date since 1970 (UTC where no zone is given).

    The year comes first, as in `2024-02-11 22:16:27.159`. Raises `ValueError` for anything else.
    """
    text = cell.strip()
    if clock := CLOCK.fullmatch(text):
        hours, minutes, whole, part = clock.groups()
        return 3600.0 * int(hours) + 60.0 * int(minutes) + int(whole) + _fraction(part)
    if not (match := DATE_AND_TIME.fullmatch(text)):
        raise ValueError(cell)
    year, _, month, day, hours, _, minutes, whole, part, zone = match.groups()
    moment = datetime(*map(int, (year, month, day, hours, minutes, whole)), tzinfo=UTC)
    return moment.timestamp() + _fraction(part) - _ahead_of_utc(zone)


def _fraction(digits: str | None) -> float:
    return float(f"0.{digits}") if digits else 0.0


def _ahead_of_utc(zone: str | None) -> float:
    """Return by how many seconds the clocks of a zone, as `+02:00`, are ahead of UTC."""
    if zone in (None, "Z", "UTC"):
        return 0.0
    return (-1.0 if zone[0] == "-" else 1.0) * (3600.0 * int(zone[1:3]) + 60.0 * int(zone[-2:]))


def _past_midnight(clock: np.ndarray) -> np.ndarray:
    """Add a day wherever a clock falls by more than half a day."""
    there = np.flatnonzero(np.isfinite(clock))
    days = np.concatenate([[0.0], np.cumsum(np.diff(clock[there]) < -DAY / 2)]) if there.size else np.zeros(0)
    clock = clock.copy()
    clock[there] += DAY * days
    return clock
