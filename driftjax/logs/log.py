"""Measured logs: runs in the log format, read from tables and recordings, checked and evenly sampled."""

import csv
import dataclasses
import hashlib
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from driftjax.core import BadInput, write_atomically
from driftjax.core.config import to_dict
from driftjax.logs import sampling
from driftjax.logs.checks import check_rates
from driftjax.logs.columns import CHANNELS, COMMANDS, EXTRA, OPTIONAL, RUN, ColumnMap, load_columns
from driftjax.logs.parse import parse_table
from driftjax.logs.prepare import Segment, prepare_segments
from driftjax.logs.raw import raw_runs
from driftjax.logs.recording import read_recording, recording_files, recording_kind
from driftjax.logs.table import Table, file_errors, read_bytes

CHUNK_SIZE = 2**20  # bytes


@dataclass(frozen=True, eq=False)
class Run:
    """One run with an even sample time: arrays (n,) in SI and radians, left positive; NaN where a value is missing."""

    name: str
    t: np.ndarray
    """Time [s]."""
    V: np.ndarray
    """Speed [m/s]."""
    beta: np.ndarray
    """Sideslip [rad], left positive; NaN throughout where the log has none."""
    r: np.ndarray
    """Yaw rate [rad/s], left positive; NaN throughout where the log has none."""
    delta: np.ndarray
    """Commanded steering angle [rad], left positive; mean over the time to the next sample."""
    Fxr: np.ndarray
    """Commanded longitudinal force of the rear axle [N], driving positive; NaN throughout where the log has none."""
    dt: float
    """Sample time [s]."""
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    """What else was measured: x, y, s, e [m], psi [rad], ax, ay [m/s^2], wheel speeds wfl, wfr, wrl, wrr [rad/s]."""
    linear: tuple[str, ...] = ()
    """Which of delta and Fxr change linearly between samples, as measured ones do; others are held."""
    yaw_rate_of_heading: bool = False
    """Whether r is the rate of the heading, for want of a sensor of its own."""

    @property
    def command_changes(self) -> np.ndarray:
        """Return the changes (n, 2) of delta [rad] and Fxr [N] over the time to the next sample, zero where held."""
        still = np.zeros(len(self.t))
        change = lambda name: sampling.changes_to_next(getattr(self, name)) if name in self.linear else still
        return np.stack([change(name) for name in COMMANDS], axis=1)


@dataclass(frozen=True, eq=False)
class Log:
    """Runs of one or several files."""

    runs: tuple[Run, ...]
    sha256: str = ""
    """Of the bytes of all files, in order, those of a folder by name."""
    paths: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    """Sentences about what was repaired or left out."""
    reading: dict[str, Any] = dataclasses.field(default_factory=dict, compare=False)
    """How `read_log` read it: keys logs, columns, runs, cut."""

    @property
    def rows(self) -> int:
        """Return the number of samples in all runs."""
        return sum(len(run.t) for run in self.runs)

    def select_runs(self, patterns: Sequence[str]) -> "Log":
        """Return the runs whose name, or the name before `@` of a split run, matches a pattern; all runs if no pattern.

        `*` matches anything.
        """
        if not patterns:
            return self
        called = lambda name: any(fnmatchcase(name, pattern) for pattern in patterns)
        kept = tuple(run for run in self.runs if called(run.name) or called(run.name.rpartition("@")[0]))
        if not kept:
            names = ", ".join(run.name for run in self.runs[:6])
            raise BadInput(f"runs: no run is called {' or '.join(patterns)}; the log holds {names}.")
        return dataclasses.replace(self, runs=kept)

    def split_runs(self, seconds: float | None) -> "Log":
        """Return runs split into parts of about `seconds`, named run@begin, so that some can be held out."""
        if seconds is None:
            return self
        parts = [part for run in self.runs for part in _cut(run, max(round(seconds / run.dt), 2))]
        return dataclasses.replace(self, runs=tuple(parts))

    def thin(self, rate: float) -> "Log":
        """Return the log with the largest whole number of samples in one that leaves `rate` [Hz] or more.

        Commands, which are held, become means over these samples; of the measurements the first one stays. A note
        says so.
        """
        dt = self.runs[0].dt
        factor = int((1 + sampling.UNIFORM) / (rate * dt))
        if factor < 2:
            return self
        note = f"All runs were thinned from {1 / dt:.4g} to {1 / (factor * dt):.4g} Hz, which resolves this car."
        runs = tuple(_run(run.name, _thin(run, factor)) for run in self.runs)
        return dataclasses.replace(self, runs=runs, notes=(*self.notes, note))


def read_log(
    paths: str | Path | Sequence[str | Path],
    columns: ColumnMap | str | None = None,
    *,
    runs: Sequence[str] = (),
    cut: float | None = None,
) -> Log:
    """Read the runs of all `paths` in the log format, or in that of a column map; raises `BadInput` in one sentence.

    `columns` is a column map, or its shipped name or file. `runs` selects by name (see `Log.select_runs`) after `cut`
    has split long runs into parts of so many seconds (see `Log.split_runs`).

    A log is a CSV, Parquet, MATLAB or VBO file or, with `columns`, a ROS bag (the folder of one of ROS 2), a folder of
    CSV files, or an MCAP, MDF, MoTeC, AiM or CarMaker file.
    A run is what its `run` column says, else a log. It is cut where t jumps by more than 3 sample times and 0.1 s,
    and where a command is missing for longer than that; the parts are called name, name+1, ...
    """
    paths = [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    if not paths:
        raise BadInput("No log was given; name one file or bag at least.")
    named = to_dict(columns) if isinstance(columns, ColumnMap) else columns
    reading = {"logs": [str(path) for path in paths], "columns": named, "runs": list(runs), "cut": cut}
    columns = load_columns(columns) if isinstance(columns, str) else columns
    digest, seen = hashlib.sha256(), dict[bytes, Path]()
    read: dict[str, Run] = {}
    notes: list[str] = []
    for path in paths:
        kind = recording_kind(path)
        content = read_bytes(path) if kind is None else b""
        own = hashlib.sha256()
        for piece in [content] if kind is None else _pieces(path):
            own.update(piece)
            digest.update(piece)
        if (twin := seen.setdefault(own.digest(), path)) is not path:
            raise BadInput(f"{path}: holds the same as {twin}; give each log once.")
        for raw in raw_runs(_table(path, kind, content, columns, notes), columns, notes):
            name = raw.name if raw.name not in read else f"{path.stem}/{raw.name}"
            for part in prepare_segments(raw, columns, notes):
                free = _free_name(name, read)
                read[free] = _run(free, part)
    if not read:
        raise BadInput(f"{', '.join(map(str, paths))}: no run has two samples in a row; give a longer log.")
    check_rates({name: run.dt for name, run in read.items()})
    log = Log(tuple(read.values()), digest.hexdigest(), tuple(paths), tuple(notes), reading)
    return log.split_runs(cut).select_runs(runs)


def _thin(run: Run, factor: int) -> Segment:
    values = {name: getattr(run, name) for name in CHANNELS[1:]} | run.extra
    return Segment(*sampling.thin(run.t, values, COMMANDS, factor), factor * run.dt, run.linear)


def _cut(run: Run, num: int) -> list[Run]:
    """Split `run` into parts of at least `num` samples; a run shorter than twice that stays whole."""
    edges = list(range(0, len(run.t) - num + 1, num)) or [0]
    parts = []
    for start, stop in zip(edges, [*edges[1:], len(run.t)], strict=True):
        of = lambda values: values[start:stop]  # noqa: B023
        main = {name: of(getattr(run, name)) for name in CHANNELS}
        extra = {key: of(values) for key, values in run.extra.items()}
        name = f"{run.name}@{run.t[start] - run.t[0]:g}" if len(edges) > 1 else run.name
        parts.append(dataclasses.replace(run, name=name, **main, extra=extra))
    return parts


def _table(path: Path, kind: str | None, content: bytes, columns: ColumnMap | None, notes: list[str]) -> Table:
    if kind is not None:
        return read_recording(path, kind, columns, notes)
    time = next((channel.column for channel in columns.columns if channel.name == "t"), None) if columns else "t"
    table = parse_table(path, content, columns.skips if columns else lambda line: False, time)
    stated = {name: unit for name, unit in zip(table.names, table.units, strict=False) if unit}
    if columns is not None:
        mapped = {channel.column for channel in columns.columns}
        stated = {name: unit for name, unit in stated.items() if name in mapped}
    if stated:
        shown = ", ".join(f"{name} {unit}" for name, unit in stated.items())
        notes.append(f"{path}: the units that it states ({shown}) change nothing; factors stand in the column map.")
    return table


def _pieces(path: Path) -> Iterator[bytes]:
    """Yield the bytes of all files of a recording, in chunks: they may exceed the memory."""
    for file in recording_files(path):
        with file_errors(file), file.open("rb") as stream:
            while piece := stream.read(CHUNK_SIZE):
                yield piece


def _run(name: str, part: Segment) -> Run:
    main = {key: part.values[key] for key in CHANNELS[1:]}
    extra = {key: part.values[key] for key in EXTRA if key in part.values}
    return Run(name, part.t, **main, dt=part.dt, extra=extra, linear=part.linear, yaw_rate_of_heading=False)


def _free_name(name: str, taken: Container[str]) -> str:
    number = 0
    while (free := f"{name}+{number}" if number else name) in taken:
        number += 1
    return free


def write_log(path: str | Path, runs: Sequence[Run]) -> None:
    """Write runs in the log format, as CSV or Parquet by the suffix of `path`, atomically.

    Missing values become empty cells; numbers keep every digit; linear commands become held means. Raises `BadInput`
    without a run, for another suffix and for a path that cannot be written.
    """
    path = Path(path)
    if not runs:
        raise BadInput(f"{path}: there is no run to write; give one at least.")
    extra = [name for name in EXTRA if any(name in run.extra for run in runs)]
    columns = {name: np.concatenate([getattr(run, name) for run in runs]) for name in CHANNELS}
    columns = {name: y for name, y in columns.items() if name not in OPTIONAL or np.isfinite(y).any()}
    for name in extra:
        columns[name] = np.concatenate([run.extra.get(name, np.full(len(run.t), np.nan)) for run in runs])
    names = [run.name for run in runs for _ in run.t]
    writers = {".csv": _write_csv, ".parquet": _write_parquet}
    if path.suffix.lower() not in writers:
        raise BadInput(f"{path}: a log is CSV or Parquet; let the name end in .csv or .parquet.")
    try:
        write_atomically(path, lambda p: writers[path.suffix.lower()](p, path, columns, names))
    except OSError as error:
        raise BadInput(f"{path}: cannot be written ({error.strerror}); give another path.") from None


def _write_csv(temporary: Path, path: Path, columns: dict[str, np.ndarray], runs: list[str]) -> None:
    with temporary.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*columns, RUN])
        cells = (["" if value != value else repr(value) for value in y.tolist()] for y in columns.values())
        writer.writerows(zip(*cells, runs, strict=True))


def _write_parquet(temporary: Path, path: Path, columns: dict[str, np.ndarray], runs: list[str]) -> None:
    import pyarrow.parquet

    table = {name: pyarrow.array(y, from_pandas=True) for name, y in columns.items()}  # NaN becomes null
    pyarrow.parquet.write_table(pyarrow.table(table | {RUN: runs}), temporary)
