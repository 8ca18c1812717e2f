"""Column maps: source columns of the channels, row conditions, and the source of the force."""

from collections.abc import Container, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from driftjax.core import BadInput, find_config, from_dict, read_yaml, require, shown
from driftjax.logs.geodesy import east_north
from driftjax.logs.series import similar_names
from driftjax.logs.table import Table

CHANNELS = ("t", "V", "beta", "r", "delta", "Fxr")
MEASURED = ("V", "beta", "r")
COMMANDS = ("delta", "Fxr")
OPTIONAL = {  # channel: what the diagnosis does without it
    "beta": "sideslip is inferred from the other channels",
    "r": "the rate of the heading stands for it",
    "Fxr": "the force is estimated from the speed, and drive, brakes and drag are not judged",
}
VELOCITIES = ("vx", "vy")
EXTRA = ("x", "y", "psi", "ax", "ay", "s", "e", "wfl", "wfr", "wrl", "wrr")
RUN = "run"

Stamps = Literal["header", "receipt"]


@dataclass(frozen=True)
class Channel:
    """One channel: `factor` times the source column plus `offset`, in SI units and radians, left positive."""

    name: str
    """Channel of the log format."""
    column: str
    """Foreign column."""
    factor: float = 1.0
    """Channel unit per unit of the column."""
    offset: float = 0.0
    """Added after the factor [channel unit]."""


@dataclass(frozen=True)
class Condition:
    """Condition on rows: the source column has one of `values`, or lies between `min` and `max`."""

    column: str
    """Foreign column."""
    values: tuple[float | str, ...] = ()
    """Values that pass; empty: any."""
    min: float | None = None
    """Least value that passes [unit of the column]."""
    max: float | None = None
    """Greatest value that passes [unit of the column]."""

    def matches(self, table: Table) -> np.ndarray:
        """Return the mask of the rows of `table` that meet the condition."""
        passes = np.ones(len(table.lines), bool)
        if self.values:
            wanted = {_plain(value) for value in self.values}
            passes &= np.array([_plain(word) in wanted for word in table.words(self.column)], bool)
        if self.min is not None:
            passes &= table.numbers(self.column) >= self.min
        if self.max is not None:
            passes &= table.numbers(self.column) <= self.max
        return passes


@dataclass(frozen=True)
class Drive:
    """Model of a part of the commanded force: (factor + factor_per_speed vx) (column - above) times [N]."""

    column: str
    """Foreign column: throttle, torque of an engine, pressure of a brake with a negative factor, or a commanded
    acceleration. Tyres and air have their part in a measured one: leave the force out, and it is estimated."""
    factor: float = 1.0
    """Force at standstill [N per unit of the column]."""
    factor_per_speed: float = 0.0
    """Change of the factor with the forward speed [N s/m per unit of the column]."""
    above: float | None = None
    """Value up to which there is no force [unit of the column]; left out: the column counts from zero both ways."""
    times: str | None = None
    """Foreign column that the force is multiplied by, such as the gear's ratio, or 1 while the motor is enabled."""

    def force(self, table: Table, vx: np.ndarray) -> np.ndarray:
        """Return the force [N] in every row at forward speed `vx` [m/s]."""
        value = table.numbers(self.column)
        value = value if self.above is None else np.maximum(value - self.above, 0.0)
        value = value if self.times is None else value * table.numbers(self.times)
        return (self.factor + self.factor_per_speed * vx) * value if self.factor_per_speed else self.factor * value


@dataclass(frozen=True)
class Position:
    """Source of the position x east and y north [m]: latitude and longitude."""

    latitude: str
    """Foreign column, north positive."""
    longitude: str
    """Foreign column, east positive unless `west_positive`."""
    factor: float = 1.0
    """Degrees per unit of both columns, such as 1/60 for minutes of arc."""
    west_positive: bool = False
    """Whether longitude counts to the west."""
    origin: tuple[float, float] | None = None
    """Latitude and longitude of x = y = 0 [deg, north and east positive]; left out: where the file begins."""

    def metres(self, table: Table) -> dict[str, np.ndarray]:
        """Return x and y in every row."""
        latitude, longitude = self.degrees(table)
        x, y = east_north(latitude, longitude, self.start(table))
        return {"x": x, "y": y}

    def start(self, table: Table) -> tuple[float, float]:
        """Return the origin; raises `BadInput` if there is no position."""
        if self.origin is not None:
            return self.origin
        latitude, longitude = self.degrees(table)
        there = np.flatnonzero(np.isfinite(latitude + longitude))
        if not there.size:
            raise BadInput(f"{table.path}: column '{self.latitude}' or '{self.longitude}' has no value in any row; "
                           "leave out 'position_from'.")  # fmt: skip
        return float(latitude[there[0]]), float(longitude[there[0]])

    def degrees(self, table: Table) -> tuple[np.ndarray, np.ndarray]:
        """Return latitude and longitude [deg], north and east positive."""
        latitude, longitude = (self.factor * table.numbers(name) for name in (self.latitude, self.longitude))
        for name, angle, most in ((self.latitude, latitude, 90), (self.longitude, longitude, 360)):
            if (far := np.abs(angle) > most).any():
                i = int(np.argmax(far))
                raise BadInput(f"{table.path}, row {table.lines[i]}: column '{name}' is {angle[i]:g} deg with the "
                               f"factor {self.factor:g}; correct key 'position_from' of the column map.")  # fmt: skip
        return latitude, -longitude if self.west_positive else longitude


@dataclass(frozen=True)
class ColumnMap:
    """How to read a foreign log."""

    columns: tuple[Channel, ...]
    """Channels; vx, vy [m/s] may stand for V, beta. In YAML `name: column` or `name: {column, factor, offset}`."""
    run: tuple[str, ...] = ()
    """Columns whose values name the run; empty: a file is one run."""
    where: tuple[Condition, ...] = ()
    """Conditions on the rows that count. In YAML `column: value`, `column: [values]` or `column: {min, max}`."""
    skip_rows: int | tuple[int, ...] = 0
    """Lines of a CSV to pass over: the first so many, or those with the listed numbers, from 1."""
    Fxr_from: tuple[Drive, ...] = ()
    """What stands for Fxr where there is no force channel: the sum of these. In YAML one or a list."""
    position_from: Position | None = None
    """What x and y are computed from where the log has latitude and longitude."""
    linear: tuple[str, ...] = ()
    """Channels `delta`, `Fxr` that were measured and change linearly from sample to sample; left out: they are held, as
    commands are."""
    rate: float | None = None
    """Sample rate to thin the log to, or to resample uneven time steps to [Hz]; left out: that of the log."""
    base: str | None = None
    """In a recording: the channel whose time stamps all others are put on; left out: the fastest measured one."""
    stamps: Stamps = "header"
    """Time stamps of messages: of their headers, where they have them, or of their receipt."""

    def __post_init__(self) -> None:
        names = [channel.name for channel in self.columns]
        known = (*CHANNELS, *VELOCITIES, *EXTRA)
        for name in names:
            require(name in known, f"key 'columns' maps '{name}'; the channels are {', '.join(known)}.")
            require(names.count(name) == 1, f"key 'columns' maps '{name}' twice; leave one.")
        require(not self.Fxr_from or "Fxr" not in names, "Fxr is in 'columns' and 'Fxr_from'; leave one.")
        require(self.position_from is None or not {"x", "y"} & set(names),
                "x or y is in 'columns' and in 'position_from'; leave one.")  # fmt: skip
        require(names.count("vx") == names.count("vy"), "key 'columns' maps one of vx and vy; map both, or V and beta.")
        lacks = first_missing(names)
        require(
            lacks is None, f"key 'columns' maps nothing to '{lacks}'; add it{_instead(lacks)}, the diagnosis needs it."
        )
        for name in self.linear:
            require(name in COMMANDS, f"key 'linear' has '{name}'; it may have {' and '.join(COMMANDS)}.")
        require(self.rate is None or self.rate > 0, f"key 'rate' is {self.rate}; it must be positive.")

        require(
            self.base is None or (self.base in names and self.base != "t"),
            f"key 'base' is '{self.base}'; it must be a channel that 'columns' maps, such as '{MEASURED[-1]}'.",
        )

    def skips(self, line: int) -> bool:
        """Return whether to skip line `line` of a CSV, counted from 1."""
        return line <= self.skip_rows if isinstance(self.skip_rows, int) else line in self.skip_rows

    @property
    def force_columns(self) -> str:
        """Return what stands for Fxr, in words."""
        names = " and ".join(f"'{one.column}'" for one in self.Fxr_from)
        return f"column{'s' if len(self.Fxr_from) > 1 else ''} {names}"

    def labels(self) -> dict[str, str]:
        """Return the name of each channel in messages."""
        named = {c.name: f"column '{c.column}'" + (f" ({c.name})" if c.column != c.name else "") for c in self.columns}
        force = {"Fxr": f"{self.force_columns} (Fxr)"} if self.Fxr_from else {}
        source = " and ".join(f"'{c.column}'" for c in self.columns if c.name in VELOCITIES)
        return {name: f"{name} (columns {source})" for name in ("V", "beta")} | force | named


def first_missing(names: Iterable[str]) -> str | None:
    """Return the first channel missing from `names` that a log must have; vx, vy provide V, psi provides r."""
    have = set(names)
    have |= {"V"} if have.issuperset(VELOCITIES) else set()
    return next((name for name in CHANNELS if name not in have | dispensable(have)), None)


def dispensable(names: Container[str]) -> set[str]:
    """Return the channels that a log with the channels `names` may lack."""
    return {name for name in OPTIONAL if name != "r" or "psi" in names}


def _instead(lacks: str | None) -> str:
    """Return what a map may have in place of the missing channel, in words."""
    return {"V": " (or vx and vy)", "r": " (or psi)"}.get(lacks or "", "")


def load_columns(name: str | Path) -> ColumnMap:
    """Load a column map from a YAML file, or a shipped one by name (`dart_jetracer`, `genesis_g80`, ...)."""
    path = find_config("columns", name)
    values = read_yaml(path)
    values["columns"] = [
        {"name": ours} | (theirs if isinstance(theirs, dict) else {"column": theirs})
        for ours, theirs in _mapping(values, "columns", path).items()
    ]
    values["where"] = [
        {"column": column}
        | (test if isinstance(test, dict) else {"values": test if isinstance(test, list) else [test]})
        for column, test in _mapping(values, "where", path).items()
    ]
    for key in (RUN, "Fxr_from"):
        if isinstance(values.get(key), str | dict):
            values[key] = [values[key]]
    return from_dict(ColumnMap, values, str(path))


def standard_columns(table: Table) -> ColumnMap:
    """Return the column map of a file in the log format."""
    velocities = [name for name in VELOCITIES if name in table]
    names = [name for name in (*CHANNELS, *EXTRA) if name in table] + velocities * (len(velocities) == 2)
    if (lacks := first_missing(names)) is not None:
        raise BadInput(
            f"{table.path}: column '{lacks}' is missing; add it{_instead(lacks)}, "
            "or name the column that holds it in a column map, "
            f"which `driftjax inspect {table.path} --guess` proposes. There are {similar_names(lacks, table.names)}."
        )
    return ColumnMap(tuple(Channel(name, name) for name in names), (RUN,) if RUN in table else ())


def map_channels(table: Table, columns: ColumnMap) -> dict[str, np.ndarray]:
    """Return all mapped channels of `table`, including V, beta and Fxr."""
    values = {c.name: c.factor * table.numbers(c.column) + c.offset for c in columns.columns}
    vx, vy = (values.pop(name, None) for name in VELOCITIES)
    if vx is not None and vy is not None:
        values = {"V": np.hypot(vx, vy), "beta": np.arctan2(vy, vx)} | values
    if columns.position_from is not None:
        values |= columns.position_from.metres(table)
    if columns.Fxr_from:
        vx = values["V"] * np.cos(values.get("beta", 0.0))
        values["Fxr"] = np.sum([one.force(table, vx) for one in columns.Fxr_from], axis=0)
    none = np.full(len(table.lines), np.nan)
    return {name: none for name in OPTIONAL} | values


def _mapping(values: dict[str, Any], key: str, path: Path) -> dict[str, Any]:
    mapping = values.get(key) or {}
    if not isinstance(mapping, dict):
        raise BadInput(f"{path}: key '{key}' is {shown(mapping)}; it needs 'column: ...' lines.")
    return mapping


def _plain(value: float | str) -> float | str:
    """Return a number if the text is one, so that 1, 1.0 and '1' are equal."""
    try:
        return float(value)
    except ValueError:
        return value
