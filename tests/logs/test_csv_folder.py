"""Folders of CSV files, one per topic with time stamps of its own: as a bag converter or a logging node writes them."""

import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.logs import guess_columns, read_log
from driftjax.logs.columns import Channel, ColumnMap, Condition
from driftjax.logs.csvfolder import csv_channels

START = 1_651_608_966  # s
G = 9.80665


def stamps(dt: float, until: float, seed: int, uneven: bool = False) -> np.ndarray:
    """Times [s]; uneven ones are those of a slow logger, 1 to 3 times `dt` apart."""
    steps = np.random.default_rng(seed).uniform(1, 3, round(until / dt)) if uneven else np.ones(round(until / dt))
    t = np.cumsum(dt * steps) - dt * steps[0]
    return t[t < until]


def signals(t: np.ndarray) -> dict[str, np.ndarray]:
    """A winding drive whose last quarter second is at standstill and backwards."""
    V = np.where(t < 19.75, 2.0 + 0.8 * np.sin(0.5 * t), -0.4)
    r = 0.9 * np.sin(0.8 * t) + 0.3 * np.cos(0.31 * t)
    psi = 0.4 + (0.9 / 0.8) * (1 - np.cos(0.8 * t)) + (0.3 / 0.31) * np.sin(0.31 * t)
    return {"V": V, "r": r, "psi": psi, "ax": np.where(t < 19.75, 0.4 * np.cos(0.5 * t), 0.0), "ay": V * r,
            "delta": 0.33 * r / np.maximum(V, 0.5)}  # fmt: skip


def write_csv(path, t: np.ndarray, columns: dict[str, np.ndarray], stamp: str = "s,ns") -> None:
    seconds, rest = np.divmod(START * 10**9 + np.round(1e9 * t).astype(np.int64), 10**9)
    head = f",{stamp},"
    shown = [f"{a},{b}" for a, b in zip(seconds, rest, strict=True)]
    if "," not in stamp:
        shown = [f"{a}{b:09d}" for a, b in zip(seconds, rest, strict=True)]  # nanoseconds in one column
    rows = zip(*columns.values(), strict=True)
    lines = [f"0,{when}," + ",".join(f"{y:.9g}" for y in row) for when, row in zip(shown, rows, strict=True)]
    path.write_text("\n".join([head + ",".join(columns), *lines]) + "\n")


def recorded(folder, uneven: bool = False, until: float = 20.0, quarter_turn: bool = True):
    """Write odometry, IMU (deg/s, g, a quarter turn to the right), pose and commands; return the folder."""
    folder.mkdir()
    t = stamps(0.02, until, 1, uneven)
    d = signals(t)
    write_csv(folder / "odom.csv", t, {"vx": d["V"], "vy": 0 * t, "wz": 0 * t})
    t = stamps(0.02, until, 2, uneven)
    d = signals(t)
    axes = {"ax": d["ay"] / G, "ay": -d["ax"] / G} if quarter_turn else {"ax": d["ax"] / G, "ay": d["ay"] / G}
    write_csv(folder / "imu.csv", t, axes | {"wz": np.degrees(d["r"])})
    t = stamps(0.02, until, 3, uneven)
    fine = np.arange(0.0, until, 1e-3)
    way = signals(fine)
    x, y = (np.cumsum(way["V"] * turn(way["psi"])) * 1e-3 for turn in (np.cos, np.sin))
    psi = np.interp(t, fine, way["psi"])
    pose = {"x": np.interp(t, fine, x), "y": np.interp(t, fine, y), "q.x": 0 * t, "q.y": 0 * t}
    write_csv(folder / "pose.csv", t, pose | {"q.z": np.sin(psi / 2), "q.w": np.cos(psi / 2)}, "stamp")
    t = stamps(0.025, until, 4)
    d = signals(t)
    write_csv(folder / "command.csv", t, {"V": np.round(d["V"]), "delta": d["delta"]})
    return folder


def column_map(**changes) -> ColumnMap:
    channels = (Channel("t", "time"), Channel("V", "odom.vx"), Channel("r", "imu.wz", np.pi / 180),
                Channel("delta", "command.delta"), Channel("psi", "pose.q.yaw"))  # fmt: skip
    return ColumnMap(channels, where=(Condition("odom.vx", min=0.2),), **changes)


def test_files_with_stamps_in_two_columns_or_one_are_one_log(tmp_path):
    log = read_log(recorded(tmp_path / "drive"), column_map())
    (run,) = log.runs
    assert run.dt == pytest.approx(0.02) and run.t[0] == 0.0
    true = signals(run.t)
    np.testing.assert_allclose(run.V, true["V"], atol=1e-6)
    np.testing.assert_allclose(run.r, true["r"], atol=1e-6)
    np.testing.assert_allclose(np.unwrap(run.extra["psi"]), true["psi"], atol=1e-6)
    assert np.isnan(run.beta).all() and run.t[-1] < 19.75  # what is driven backwards is left out


def test_stamps_are_no_channels_and_a_quaternion_has_a_heading(tmp_path):
    channels = csv_channels(recorded(tmp_path / "drive"))
    assert "pose.q.yaw" in channels and not {"imu.s", "imu.ns", "pose.stamp", "imu."} & set(channels)


def test_uneven_stamps_are_resampled_to_the_rate_that_the_error_proposes(tmp_path):
    """Steps of 20 to 60 ms, others in each file."""
    folder = recorded(tmp_path / "drive", uneven=True)
    with pytest.raises(BadInput, match=r"vary by \d+ %.*write 'rate: 2\d' in a column map"):
        read_log(folder, column_map())
    with pytest.raises(BadInput, match="write 'rate"):  # more often than it was sampled
        read_log(folder, column_map(rate=50))
    log = read_log(folder, column_map(rate=20))
    assert any("resampled to 20 Hz" in note for note in log.notes)
    assert sum(len(run.t) for run in log.runs) > 0.95 * 19.75 * 20
    for run in log.runs:
        assert run.dt == pytest.approx(0.05)
        there = np.isfinite(run.r)
        assert there.mean() > 0.9
        np.testing.assert_allclose(run.r[there], signals(run.t)["r"][there], atol=5e-3)  # linear over 0.1 s


def test_the_guess_takes_what_was_measured_and_turns_a_turned_sensor(tmp_path):
    """No commanded speed, no zero yaw rate of an odometry, a speed without sideways speed, axes by what they follow."""
    guess = guess_columns(recorded(tmp_path / "drive", uneven=True))
    got = {one.channel: (one.column, round(one.factor, 6)) for one in guess.channels}
    assert got["V"] == ("odom.vx", 1.0) and "vx" not in got
    assert got["r"] == ("imu.wz", round(np.pi / 180, 6)) and got["delta"] == ("command.delta", 1.0)
    assert got["ay"] == ("imu.ax", G) and got["ax"] == ("imu.ay", -G)
    assert {got[name][0] for name in ("x", "y", "psi")} == {"pose.x", "pose.y", "pose.q.yaw"}
    assert any("quarter turn" in sentence for sentence in guess.open)
    assert guess.rate is not None and [one.column for one in guess.where] == ["odom.vx"]
    assert read_log(tmp_path / "drive", guess.column_map()).runs
    guess.write(tmp_path / "map.yaml")
    assert len(read_log(tmp_path / "drive", str(tmp_path / "map.yaml")).runs) >= 1


def test_a_sensor_that_is_mounted_straight_keeps_its_axes(tmp_path):
    guess = guess_columns(recorded(tmp_path / "drive", quarter_turn=False))
    got = {one.channel: (one.column, one.factor) for one in guess.channels}
    assert got["ax"] == ("imu.ax", G) and got["ay"] == ("imu.ay", G)
    assert not any("quarter turn" in sentence for sentence in guess.open) and guess.rate is None


def spoil(folder, how: str) -> None:
    imu = folder / "imu.csv"
    lines = imu.read_text().splitlines()
    if how == "no time":
        lines[0] = lines[0].replace(",s,ns,", ",a,b,")
    elif how == "empty time":
        lines[3] = lines[3].replace(f",{START},", ",,")
    elif how == "text":
        lines[3] = lines[3].rpartition(",")[0] + ",left"
    elif how == "two clocks":
        lines = [line.replace(f",{START // 1000}", ",17") for line in lines]
    elif how == "short row":
        lines[3] = lines[3].rpartition(",")[0]
    imu.write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("no time", r"imu.csv: has no column of time"),
        ("empty time", r"imu.csv, row 4: column 's', the time, is empty"),
        ("text", r"imu.csv, row 4: column 'wz' holds 'left'"),
        ("two clocks", r"begins .* s after the end of 'imu.csv'"),
        ("short row", r"imu.csv, row 4: has 5 cells for 6 columns"),
    ],
)
def test_malformed_files_are_refused_in_one_sentence(tmp_path, how, says):
    spoil(recorded(tmp_path / "drive"), how)
    with pytest.raises(BadInput, match=says):
        read_log(tmp_path / "drive", column_map())


def test_a_wrong_column_and_an_empty_folder_are_named(tmp_path):
    folder = recorded(tmp_path / "drive")
    channels = (Channel("t", "time"), Channel("V", "odom.speed"), Channel("r", "imu.wz"), Channel("delta", "imu.ax"))
    with pytest.raises(BadInput, match=r"has no channel 'odom.speed'; it has 'odom\.\w+'"):
        read_log(folder, ColumnMap(channels))
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput, match="without CSV files"):
        read_log(tmp_path / "empty", ColumnMap(channels))
    with pytest.raises(BadInput, match=r"needs a column map.*'command.V'"):
        read_log(folder)


def test_the_shipped_map_reads_the_files_of_its_logger(tmp_path):
    """Names as that node writes them; what it calls an angular velocity of the odometry is a copy of the speed."""
    folder = recorded(tmp_path / "drive", uneven=True)
    for ours, theirs in (("odom", "odomData"), ("imu", "imuData"), ("pose", "pfPoseData"), ("command", "commandData")):
        (folder / f"{ours}.csv").rename(folder / f"{theirs}.csv")
    log = read_log(folder, "f1tenth_frictionmaps")
    for run in log.runs:
        true = signals(run.t)
        assert run.dt == pytest.approx(1 / 16)
        there = np.isfinite(run.extra["ay"]) & np.isfinite(run.r) & (run.t < 19.6)  # it rolls backwards soon after
        np.testing.assert_allclose(run.extra["ay"][there], true["ay"][there], atol=0.05)
        np.testing.assert_allclose(run.extra["ax"][there], true["ax"][there], atol=0.02)
        np.testing.assert_allclose(run.r[there], true["r"][there], atol=0.01)


def test_a_table_without_names_is_reported(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("0.0,1.5,0.1\n0.1,1.6,0.2\n0.2,1.7,0.1\n")
    with pytest.raises(BadInput, match=r"log.csv, row 1: holds numbers where the names of the columns should be"):
        read_log(path)
