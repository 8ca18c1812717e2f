"""Recordings (ROS bags, MCAP, MDF, MoTeC, AiM, CarMaker, folders of CSV), whose columns have own clocks, as a table."""

from collections.abc import Callable, Collection, Iterable
from itertools import chain
from pathlib import Path

import numpy as np

from driftjax.core import BadInput
from driftjax.logs import aim, carmaker, csvfolder, mcapfile, mdf, motec, rosbag, sampling
from driftjax.logs.columns import COMMANDS, ColumnMap, Stamps
from driftjax.logs.messages import Message, number_columns, read_series
from driftjax.logs.series import Series, check_series, quote_names
from driftjax.logs.table import Table, file_errors

TIME = "time"  # column of a recording that holds the time base
KINDS = {
    b"#ROSBAG": rosbag.KIND,
    b"SQLite format 3\0": rosbag.KIND,
    b"\x89MCAP": mcapfile.KIND,
    b"MDF     ": mdf.KIND,
    b"UnFinMF ": mdf.KIND,
    motec.MAGIC: motec.KIND,
    carmaker.MAGIC: carmaker.KIND,
}  # by the first bytes of the file
CHANNELS: dict[str, tuple[Callable[[Path], dict[str, str]], Callable[[Path, list[str]], dict[str, Series]]]] = {
    mdf.KIND: (mdf.mdf_channels, mdf.mdf_series),
    motec.KIND: (motec.motec_channels, motec.motec_series),
    aim.KIND: (aim.aim_channels, aim.aim_series),
    carmaker.KIND: (carmaker.carmaker_channels, carmaker.carmaker_series),
    csvfolder.KIND: (csvfolder.csv_channels, csvfolder.csv_series),
}  # of recordings without messages: units by channel, samples by channel


def recording_kind(path: Path) -> str | None:
    """Return the kind of recording of `path`, by its first bytes; None for any other file."""
    with file_errors(path):
        if path.is_dir():
            if (path / "metadata.yaml").is_file():
                return rosbag.KIND
            if csvfolder.csv_files(path):
                return csvfolder.KIND
            raise BadInput(f"{path}: is a folder without the metadata.yaml of a ROS 2 bag and without CSV files; "
                           "give a bag or a file.")  # fmt: skip
        if not path.is_file():
            return None  # nothing there, or a pipe, whose first bytes would be lost
        with path.open("rb") as stream:
            start = stream.read(max(map(len, KINDS)))
    is_aim = aim.is_aim(path, start)
    return next((kind for magic, kind in KINDS.items() if start.startswith(magic)), aim.KIND if is_aim else None)


def recording_files(path: Path) -> list[Path]:
    """Return the files that a recording consists of: those of a folder by name, that beside a CarMaker file."""
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        return csvfolder.csv_files(path)
    if path.is_dir():
        return sorted(one for one in path.rglob("*") if one.is_file())
    return [path, *([info] if (info := carmaker.info_path(path)).is_file() else [])]


def read_recording(path: Path, kind: str, columns: ColumnMap | None, notes: list[str]) -> Table:
    """Read the mapped columns of a recording on the time stamps of one of its channels.

    Measured channels are interpolated, commands held over up to 3 lost samples, and other mapped columns, such as
    those of conditions, held until the next sample; values are missing where samples are.
    """
    if columns is None:
        names = _names(path, kind)
        holds = quote_names(names, len(names)) or "nothing"
        raise BadInput(f"{path}: a recording needs a column map that says what is what; it holds {holds}; "
                       f"`driftjax inspect {path} --guess` proposes one.")  # fmt: skip
    if wrong := [channel.name for channel in columns.columns if channel.column == TIME and channel.name != "t"]:
        raise BadInput(f"{path}: the column map says that {wrong[0]} is '{TIME}', the time stamps; only t can be that.")
    roles = _roles(columns)
    series_of = _series(path, kind, roles, columns.stamps, notes)
    for name, series in series_of.items():
        check_series(path, name, series, fewest=1 if roles[name] == "state" else 2)
    base = _base(series_of, roles, columns)
    if len({series.source for series in series_of.values()}) > 1:
        rate = 1 / sampling.sample_time(series_of[base].t)
        notes.append(f"{path}: all columns were put on the time stamps of '{series_of[base].source}', {rate:.4g} Hz.")
    t = series_of[base].t
    turning = {channel.column: channel.factor for channel in columns.columns if channel.name == "psi"}
    values = {name: _at(t, series, roles[name], turning.get(name)) for name, series in series_of.items()}
    return Table(path, (TIME, *values), (t, *values.values()), np.arange(1, len(t) + 1))


def _names(path: Path, kind: str) -> list[str]:
    if kind in CHANNELS:
        return sorted(CHANNELS[kind][0](path))
    return {rosbag.KIND: rosbag.bag_topics, mcapfile.KIND: mcapfile.mcap_topics}[kind](path)


def _series(path: Path, kind: str, names: Iterable[str], stamps: Stamps, notes: list[str]) -> dict[str, Series]:
    if kind in CHANNELS:
        return CHANNELS[kind][1](path, list(names))
    return read_series(path, names, _names(path, kind), lambda topics: _messages(path, kind, topics, notes), stamps)


def _messages(path: Path, kind: str, topics: Collection[str], notes: list[str]) -> Iterable[Message]:
    return rosbag.bag_messages(path, topics, notes) if kind == rosbag.KIND else mcapfile.mcap_messages(path, topics)


def all_series(path: Path, kind: str, stamps: Stamps) -> dict[str, tuple[str, Series]]:
    """Return unit and samples of every column of numbers; unreadable columns are left out."""
    if kind in CHANNELS:
        units, read = CHANNELS[kind][0](path), CHANNELS[kind][1]
        try:
            series_of = read(path, list(units))
        except BadInput:  # one of them holds text, say
            series_of = {name: series for name in units for series in _if_readable(read, path, name)}
        return {name: (units[name], series) for name, series in series_of.items()}
    topics, first = _names(path, kind), dict[str, Message]()
    for message in _messages(path, kind, topics, []):
        first.setdefault(message.topic, message)
        if len(first) == len(topics):
            break
    names = [name for topic, one in first.items() for name in number_columns(topic, one.content) if name != topic]
    return {name: ("", series) for name, series in _series(path, kind, names, stamps, []).items()}


def _if_readable(read: Callable[[Path, list[str]], dict[str, Series]], path: Path, name: str) -> list[Series]:
    try:
        return [read(path, [name])[name]]
    except BadInput:
        return []


def _roles(columns: ColumnMap) -> dict[str, str]:
    """Return the role of every mapped column except the time: measured, command or state."""
    state = [*columns.run, *(condition.column for condition in columns.where)]
    state += [drive.times for drive in columns.Fxr_from if drive.times]
    held = [name for name in COMMANDS if name not in columns.linear]
    command = [channel.column for channel in columns.columns if channel.name in held]
    measured = [channel.column for channel in columns.columns if channel.name not in held]
    (command if "Fxr" in held else measured).extend(drive.column for drive in columns.Fxr_from)
    measured += [columns.position_from.latitude, columns.position_from.longitude] if columns.position_from else []
    ranks = {"measured": measured, "command": command, "state": state}  # what is measured is, whatever else it is for
    roles = dict(chain.from_iterable(((name, role) for name in names) for role, names in reversed(ranks.items())))
    return {name: role for name, role in roles.items() if name != TIME}


def _base(series_of: dict[str, Series], roles: dict[str, str], columns: ColumnMap) -> str:
    """Return the column of the time base: the map's base, else the fastest measured, the first of equals."""
    if columns.base is not None:
        return next(channel.column for channel in columns.columns if channel.name == columns.base)
    measured = [name for name, role in roles.items() if role == "measured"]
    steps = {name: sampling.sample_time(series_of[name].t) for name in measured}
    return next(name for name in measured if steps[name] <= (1 + sampling.UNIFORM) * min(steps.values()))


def _at(times: np.ndarray, series: Series, role: str, turning: float | None) -> np.ndarray:
    """Return the series at `times`; `turning` is the factor to radians if the values are a heading."""
    if role == "state":
        return sampling.sample_and_hold(times, series.t, series.y, sampling.sample_time(times))
    dt = sampling.spacing(series.t)
    if role == "command":
        return sampling.sample_and_hold(times, series.t, series.y, dt, lost=sampling.held_samples(dt))
    y = series.y if turning is None else sampling.unwrap(turning * series.y) / turning
    return sampling.interpolate(times, series.t, y, dt)
