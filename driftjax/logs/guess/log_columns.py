"""Read all numeric columns of any log onto one even time base."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.cells import cells_as_numbers
from driftjax.logs.columns import Stamps
from driftjax.logs.guess.names import meaning
from driftjax.logs.parse import parse_table
from driftjax.logs.recording import TIME, all_series, recording_kind
from driftjax.logs.sampling import even_rate
from driftjax.logs.stamps import units_of_time
from driftjax.logs.table import read_bytes

FINEST = 0.02  # s, of the time base
MOST = 10000  # samples; a longer log is read from its start
GAP = 0.5  # s, over which values are interpolated
FEW = 3  # different values up to which a column is a flag, unless its name says what it measures
CLEAR = 0.9  # score of such a name
NUMERIC = 0.9  # share of cells that must be numbers
LEAST_TIME = 0.3  # least score of the name of a time
JUMP = 0.9  # share of a turn that is a jump of an angle
SMOOTH = 0.99  # share of the other steps of an angle that must be small
ABSURD = 1e6  # times the size of most values of a column, from which one is none that was measured
LARGEST = 1e30  # size of any measured quantity, in any unit


class Column(NamedTuple):
    """One column on the even time base."""

    name: str
    unit: str
    y: np.ndarray
    """Values (n,) in the unit of the file, NaN between runs and in gaps."""


class LogColumns(NamedTuple):
    """Columns of a log on one even time base."""

    path: Path
    dt: float
    """Of the even time base [s]."""
    time: str
    """Column of time."""
    time_factor: float
    """[s per unit of it]"""
    run: str | None
    """Column that separates runs, in each of which time starts again."""
    columns: list[Column]
    flags: list[str]
    """Columns of two or three values."""
    constant: list[str]
    """Columns of one value or none."""
    stamps: Stamps
    rates: dict[str, float]
    """Samples per second of columns with uneven time steps [Hz]."""
    absurd: list[str]
    """Columns with values that no sensor measures, which are left out here."""


def read_log_columns(path: Path) -> LogColumns:
    """Read every column of a log; raises `BadInput` as `read_log` does, or if no column is the time."""
    kind = recording_kind(path)
    return _of_table(path) if kind is None else _of_recording(path, kind)


def _of_table(path: Path) -> LogColumns:
    table = parse_table(path, read_bytes(path), lambda line: False)
    units = table.units or ("",) * len(table.names)
    numbers: dict[str, np.ndarray] = {}
    words: dict[str, Sequence[str]] = {}
    for name, column in zip(table.names, table.columns, strict=True):
        if not name:  # of an empty last cell
            continue
        values = column if isinstance(column, np.ndarray) else _numbers(column)
        if values is None:
            words[name] = [str(cell) for cell in column]
        elif table.names.count(name) == 1:
            numbers[name] = np.where(np.isfinite(values), values, np.nan)
    time, factor = _time(path, numbers)
    t = factor * numbers.pop(time)
    breaks = np.flatnonzero(~(np.diff(t) > 0)) + 1
    steps = np.diff(t)
    dt = max(float(np.median(steps[steps > 0])), FINEST)
    edges = [0, *breaks.tolist(), len(t)]
    parts = [slice(a, b) for a, b in zip(edges, edges[1:], strict=False) if b - a > 1]
    grids = [np.arange(t[part.start], t[part.stop - 1], dt) for part in parts]
    while len(grids) > 1 and sum(map(len, grids)) > MOST:
        grids.pop()
    grids = [grid[:MOST] for grid in grids]
    apart = np.full(round(2 * GAP / dt), np.nan)  # so that nothing is smoothed from run to run
    on_grid = lambda y: np.concatenate(
        [np.append(_at(grid, t[part], y[part]), apart) for grid, part in zip(grids, parts, strict=False)]
    )
    by_unit = dict(zip(table.names, units, strict=True))
    read = [(name, by_unit[name], y) for name, y in numbers.items()]
    run = _run(breaks, words, numbers)
    usable, flags, constant = _by_values([one for one in read if one[0] != run])
    columns = [Column(name, unit, on_grid(measured(y))) for name, unit, y in usable]
    longest = t[max(parts, key=lambda part: part.stop - part.start)] if parts else t
    rates = {name: rate for name in numbers for rate in _uneven(longest)}
    return LogColumns(path, dt, time, factor, run, columns, flags, constant, "header", rates, _absurd(usable))


def _of_recording(path: Path, kind: str) -> LogColumns:
    stamps: Stamps = "header"
    try:
        series = all_series(path, kind, stamps)
    except BadInput:
        stamps = "receipt"  # where headers have no time stamps, or of several clocks
        series = all_series(path, kind, stamps)
    rising = lambda t: len(t) > 1 and bool((np.diff(t) > 0).all())
    series = {name: (unit, one) for name, (unit, one) in series.items() if rising(one.t)}
    if not series:
        raise BadInput(f"{path}: holds no column of numbers over time; record one.")
    steps = [float(np.median(np.diff(one.t))) for _, one in series.values()]
    dt = max(min(steps), FINEST)
    start, end = min(one.t[0] for _, one in series.values()), max(one.t[-1] for _, one in series.values())
    grid = np.arange(start, end, dt)[:MOST]
    usable, flags, constant = _by_values([(name, unit, one.y) for name, (unit, one) in series.items()])
    columns = [Column(name, unit, _at(grid, series[name][1].t, measured(y))) for name, unit, y in usable]
    rates = {name: rate for name, _, _ in usable for rate in _uneven(series[name][1].t)}
    return LogColumns(path, dt, TIME, 1.0, None, columns, flags, constant, stamps, rates, _absurd(usable))


def measured(y: np.ndarray) -> np.ndarray:
    """Return `y` with NaN for values of absurd size: of damaged bytes, say; their squares would overflow."""
    size = np.abs(y)
    some = size[np.isfinite(size) & (size > 0)]
    most = min(ABSURD * float(np.median(some)), LARGEST) if some.size else LARGEST
    return np.where(size <= most, y, np.nan)


def _absurd(columns: list[tuple[str, str, np.ndarray]]) -> list[str]:
    return [name for name, _, y in columns if (np.isfinite(y) & np.isnan(measured(y))).any()]


def _uneven(t: np.ndarray) -> list[float]:
    """Return the samples per second of uneven time stamps in a list; empty for even ones."""
    rate = even_rate(t) if len(t) > 2 else None
    return [] if rate is None else [rate]


def _by_values(columns: list[tuple[str, str, np.ndarray]]) -> tuple[list[tuple], list[str], list[str]]:
    """Return the columns that measure something, the names of flags, and those of columns of one value or none."""
    usable, flags, constant = [], [], []
    for name, unit, y in columns:
        different = np.unique(y[np.isfinite(y)])
        clear = max(meaning(name, unit).name_score.values()) >= CLEAR
        if len(different) < 2 and not (clear and different.any()):  # a force may be constant; zeros fill up messages
            constant.append(name)
        elif len(different) <= FEW and not clear:
            flags.append(name)
        else:
            usable.append((name, unit, y))
    return usable, flags, constant


def _numbers(cells: Sequence[str]) -> np.ndarray | None:
    """Return text as numbers, NaN where one is missing; None if it is no column of numbers."""
    values, wrong = cells_as_numbers(cells)
    return values if len(wrong) <= (1 - NUMERIC) * len(cells) else None


def _time(path: Path, numbers: dict[str, np.ndarray]) -> tuple[str, float]:
    """Return the column of time, and seconds per unit of it."""
    best, best_column = 0.0, None
    for name, y in numbers.items():
        steps = np.diff(y)
        rising = float(np.mean(steps > 0)) if len(steps) else 0.0
        meant = meaning(name)
        if (
            rising < 0.9
            or meant.name_score["t"] < LEAST_TIME
            or np.ptp(steps[steps > 0]) > 1e6 * np.median(steps[steps > 0])
        ):
            continue
        even = 1.0 - min(float(np.std(steps[steps > 0]) / np.mean(steps[steps > 0])), 1.0)
        score = meant.name_score["t"] * rising * (0.5 + 0.5 * even)
        if score > best:
            fits = units_of_time(y)
            factor = meant.unit.factor if meant.unit and meant.unit.factor in fits else (fits[0] if fits else 1.0)
            best, best_column = score, (name, factor)
    if best_column is None:
        raise BadInput(f"{path}: no column rises like a time and is named like one; call it 't', in seconds, or write "
                       "the column map by hand (columns: t: its name).")  # fmt: skip
    return best_column


def _run(breaks: np.ndarray, words: dict[str, Sequence[str]], numbers: dict[str, np.ndarray]) -> str | None:
    """Return the column that changes where time restarts and most seldom elsewhere."""
    changes = {name: {i for i in range(1, len(cells)) if cells[i] != cells[i - 1]} for name, cells in words.items()}
    changes |= {name: set((np.flatnonzero(np.diff(y)) + 1).tolist()) for name, y in numbers.items()}
    wanted = set(breaks.tolist())
    if not wanted:
        return next((name for name in ("run", "lap", "session") if name in words), None)
    fits = [name for name, rows in changes.items() if wanted <= rows and len(rows) <= 2 * len(wanted)]
    return min(fits, key=lambda name: len(changes[name]), default=None)


def _at(grid: np.ndarray, t: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return `y` at the times of `grid`, NaN where it is not known nearby; angles turn the short way."""
    there = np.isfinite(y) & np.isfinite(t)
    if there.sum() < 2:
        return np.full(len(grid), np.nan)
    t, y = t[there], unwrapped(y[there])
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    far = t[after] - t[after - 1] > GAP
    return np.where(far | (grid < t[0]) | (grid > t[-1]), np.nan, np.interp(grid, t, y))


def unwrapped(y: np.ndarray) -> np.ndarray:
    """Return `y` without the jumps of an angle by a whole turn, in degrees or radians; unchanged without jumps."""
    steps = np.abs(np.diff(y))
    for turn in (2 * np.pi, 360.0):
        jumps = steps > JUMP * turn
        if jumps.any() and np.ptp(y) <= 1.01 * turn and jumps.sum() < 0.02 * len(y) and _smooth(steps[~jumps], turn):
            return np.unwrap(y, period=turn)
    return y


def _smooth(steps: np.ndarray, turn: float) -> bool:
    """Return whether all but single steps, as where a simulator starts anew, are a small part of a turn."""
    return bool(steps.size) and float(np.quantile(steps, SMOOTH)) < turn / 6
