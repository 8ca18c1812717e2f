"""Read RaceLogic VBO files: text in sections, one time base.

Times become seconds since the midnight before the start, latitude and longitude degrees north and east: the file has
HHMMSS.SS, and minutes of arc that count positive to the north and to the west (RaceLogic, VBO file format).
"""

import re
from pathlib import Path

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.table import Table, decode_text

MARK = re.compile(rb"^\s*\[column names\]", re.MULTILINE | re.IGNORECASE)
HEAD = 2**16  # bytes in which the section of names must begin
DAY = 86400.0  # s
TIME, LATITUDE, LONGITUDE = ("time",), ("lat", "latitude"), ("long", "lon", "longitude")
UNITS = {"kmh": "km/h", "km/h": "km/h", "knots": "kn", "mph": "mph", "m/s": "m/s"}
STANDARD = {"time": "s", "lat": "deg", "latitude": "deg", "long": "deg", "lon": "deg", "longitude": "deg",
            "velocity": "km/h", "heading": "deg", "height": "m", "vertvel": "km/h", "vert-vel": "km/h", "sats": "",
            "event1": "s"}  # fmt: skip


def is_vbo(content: bytes) -> bool:
    """Return whether the bytes of a file are those of a VBO file."""
    return MARK.search(content[:HEAD]) is not None


def vbo_table(path: Path, content: bytes) -> Table:
    """Return the columns of the file by their names there; raises `BadInput` that names the row."""
    sections = _sections(content)
    names = tuple(name for _, line in sections.get("column names", []) for name in line.split())
    rows = [(number, line.split()) for number, line in sections.get("data", []) if line]
    if not names or not rows:
        raise BadInput(f"{path}: has no [column names] or no rows under [data]; log it again.")
    for number, cells in rows:
        if len(cells) != len(names):
            raise BadInput(f"{path}, row {number}: has {len(cells)} cells for {len(names)} columns; correct the row.")
    lines = np.array([number for number, _ in rows])
    table = Table(path, names, tuple(zip(*(cells for _, cells in rows), strict=True)), lines, _units(sections, names))
    return _converted(table)


def _sections(content: bytes) -> dict[str, list[tuple[int, str]]]:
    """Return the lines of each section with their numbers, from 1."""
    sections: dict[str, list[tuple[int, str]]] = {}
    into: list[tuple[int, str]] = []
    for number, line in enumerate(decode_text(content).splitlines(), start=1):
        if title := re.fullmatch(r"\[(.+)\].*", line.strip()):
            into = sections.setdefault(title[1].strip().lower(), [])
        else:
            into.append((number, line.strip()))
    return sections


def _units(sections: dict[str, list[tuple[int, str]]], names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the units of standard columns, as the titles in the header have them, and of the other channels."""
    titles = [line.lower().split() for _, line in sections.get("header", []) if line]
    own = iter([line for _, line in sections.get("channel units", [])])
    units = []
    for k, name in enumerate(names):
        words = titles[k] if k < len(titles) else []
        stated = next((UNITS[word] for word in words if word in UNITS), None)
        known = STANDARD.get(name.lower())
        units.append(stated or (known if known is not None else next(own, "")))
    return tuple(units)


def _converted(table: Table) -> Table:
    """Return the table with time in seconds and latitude and longitude in degrees, missing where there is no fix."""
    first = lambda kinds: next((name for name in table.names if name.lower() in kinds), None)
    time, latitude, longitude = map(first, (TIME, LATITUDE, LONGITUDE))
    new: dict[str, np.ndarray] = {}
    if time is not None:
        new[time] = _seconds(table, time)
    if latitude is not None and longitude is not None:
        north, west = table.numbers(latitude), table.numbers(longitude)
        if (far := (np.abs(north) > 90 * 60) | (np.abs(west) > 180 * 60)).any():
            row = table.lines[np.argmax(far)]
            raise BadInput(f"{table.path}, row {row}: '{latitude}' or '{longitude}' is no angle in minutes of arc; "
                           "correct the row.")  # fmt: skip
        fix = (north != 0) | (west != 0)
        new[latitude], new[longitude] = np.where(fix, north / 60, np.nan), np.where(fix, -west / 60, np.nan)
    columns = tuple(new.get(name, column) for name, column in zip(table.names, table.columns, strict=True))
    return Table(table.path, table.names, columns, table.lines, table.units)


def _seconds(table: Table, name: str) -> np.ndarray:
    """Return HHMMSS.SS as seconds that go on counting past midnight."""
    clock = table.numbers(name)
    hours, rest = np.divmod(clock, 10000)
    minutes, seconds = np.divmod(rest, 100)
    if (bad := (clock < 0) | (hours > 24) | (minutes >= 60) | (seconds >= 61)).any():
        i = int(np.argmax(bad))
        raise BadInput(f"{table.path}, row {table.lines[i]}: '{name}' is {clock[i]:g}, no time HHMMSS.SS; "
                       "correct the row.")  # fmt: skip
    t = np.round(3600 * hours + 60 * minutes + seconds, 6)
    return t + DAY * np.cumsum(np.diff(np.nan_to_num(t), prepend=np.nan_to_num(t[:1])) < -DAY / 2)
