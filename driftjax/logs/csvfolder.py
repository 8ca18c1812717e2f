"""Read folders of CSV files, one per topic with its own time stamps, as loggers and bag converters write them."""

import re
from collections import defaultdict
from collections.abc import Iterable
from itertools import permutations
from pathlib import Path

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.cells import MISSING, is_number
from driftjax.logs.fields import QUATERNION, heading
from driftjax.logs.parse import parse_table
from driftjax.logs.series import Series, pick_channels
from driftjax.logs.stamps import NANOSECONDS, SECONDS, units_of_time
from driftjax.logs.table import Table, read_bytes

KIND = "folder of CSV files"
WHOLE, REST = (*SECONDS, "s"), (*NANOSECONDS, "ns", "nanoseconds")  # of a time in two columns
TIMES = ("t", "time", "timestamp", "stamp", "headerstamp", "fieldheaderstamp", "rosbagtimestamp")  # letters only


def csv_files(path: Path) -> list[Path]:
    """Return the CSV files in a folder, by name."""
    return sorted(one for one in path.iterdir() if one.is_file() and one.suffix.lower() == ".csv")


def csv_channels(path: Path) -> dict[str, str]:
    """Return the unit of every column of numbers, called `file.column`; `file.q.yaw` is that of q.x, q.y, q.z, q.w."""
    tables = map(_table, csv_files(path))
    return {f"{table.path.stem}.{name}": unit for table in tables for name, unit in _columns(table).items()}


def csv_series(path: Path, names: list[str]) -> dict[str, Series]:
    """Return the columns `names`; time counts from the first row of the files that they are in."""
    files = csv_files(path)
    wanted = [file for file in files if any(name.startswith(f"{file.stem}.") for name in names)]
    tables = {file.stem: _table(file) for file in wanted or files}
    there = [(f"{stem}.{name}", (stem, name)) for stem, table in tables.items() for name in _columns(table)]
    places = pick_channels(path, names, there)
    stamps = {stem: _nanoseconds(tables[stem]) for stem, _ in places.values()}
    start = min((int(times[0]) for times in stamps.values()), default=0)
    seconds = {stem: (times - start) / 1e9 for stem, times in stamps.items()}
    _check_clocks(path, seconds)
    return {name: Series(stem, seconds[stem], _values(tables[stem], column))
            for name, (stem, column) in places.items()}  # fmt: skip


def _table(file: Path) -> Table:
    return parse_table(file, read_bytes(file), lambda line: False)


def _columns(table: Table) -> dict[str, str]:
    """Return the unit of every column that begins with a number, and of the headings of quaternions."""
    units = dict(zip(table.names, table.units or ("",) * len(table.names), strict=True))
    times = _time_columns(table)
    numeric = {name: unit for name, unit in units.items() if name and name not in times and _has_numbers(table, name)}
    return numeric | {
        f"{before}.yaw": "rad" for before, parts in _vectors(numeric).items() if set(parts) == set("xyzw")
    }


def _vectors(names: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the columns of each vector or quaternion, by its name and x, y, z or w."""
    vectors = defaultdict[str, dict[str, str]](dict)
    for name in names:
        if match := re.fullmatch(r"(.+)[._/]([xyzw])", name):
            vectors[match[1]][match[2]] = name
    return vectors


def _has_numbers(table: Table, name: str) -> bool:
    if table.names.count(name) > 1:
        return False
    return is_number(next((cell for cell in table.words(name) if cell.lower() not in MISSING), ""))


def _values(table: Table, name: str) -> np.ndarray:
    if name in table:
        return table.numbers(name)
    parts = _vectors(table.names)[name.removesuffix(".yaw")]
    return heading(*(table.numbers(parts[one]) for one in QUATERNION))


def _nanoseconds(table: Table) -> np.ndarray:
    """Return the time of every row [ns]."""
    times = [_whole_column(table, name) for name in _time_columns(table)]
    if not times:
        raise BadInput(f"{table.path}: has no column of time; call one 'time', or two 'sec' and 'nanosec'.")
    units = [1e9, 1.0] if len(times) == 2 else [1e9 * next(iter(units_of_time(times[0])), 1.0)]
    parts = [np.round(values * unit).astype(np.int64) for values, unit in zip(times, units, strict=True)]
    return np.sum(parts, axis=0)


def _time_columns(table: Table) -> tuple[str, ...]:
    """Return the columns of seconds and nanoseconds, or the one of time; none if there are none."""
    if pair := next((one for one in permutations(table.names, 2) if _are_stamp(*one)), None):
        return pair
    by_letters = {re.sub("[^a-z]", "", name.lower()): name for name in reversed(table.names)}
    return tuple(by_letters[one] for one in TIMES if one in by_letters)[:1]


def _are_stamp(seconds: str, rest: str) -> bool:
    """Return whether two columns are the seconds and nanoseconds of one time stamp."""
    before, same = (name[: len(name) - len(_last_word(name))] for name in (seconds, rest))
    return before == same and _last_word(seconds) in WHOLE and _last_word(rest) in REST


def _last_word(name: str) -> str:
    return re.split("[^a-z]", name.lower())[-1]


def _whole_column(table: Table, name: str) -> np.ndarray:
    values = table.numbers(name)
    if np.isnan(values).any():
        line = table.lines[np.argmax(np.isnan(values))]
        raise BadInput(f"{table.path}, row {line}: column '{name}', the time, is empty; leave the row out.")
    return values


def _check_clocks(path: Path, seconds: dict[str, np.ndarray]) -> None:
    """Raise `BadInput` if no moment is in all files."""
    if not seconds:
        return
    late, early = max(seconds, key=lambda stem: seconds[stem][0]), min(seconds, key=lambda stem: seconds[stem][-1])
    if seconds[late][0] > seconds[early][-1]:
        raise BadInput(f"{path}: '{late}.csv' begins {seconds[late][0] - seconds[early][-1]:.4g} s after the end of "
                       f"'{early}.csv', as if by two clocks; give files of one recording.")  # fmt: skip
