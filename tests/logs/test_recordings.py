"""ROS bags, MCAP and MDF files give the log that was driven, whatever their rates, gaps and clocks."""

import hashlib
import sqlite3
from dataclasses import replace
from pathlib import Path

import bags
import numpy as np
import pytest
from asammdf import MDF, Signal
from scipy.spatial.transform import Rotation

from driftjax.cli import main
from driftjax.logs import Log, read_log, sampling
from driftjax.logs.columns import load_columns


def every(dt: float, until: float = 10.0, jitter: float = 0.0, seed: int = 0) -> np.ndarray:
    """Time stamps [ns] every `dt` [s], off by up to `jitter` of it; the first at 0."""
    k = np.arange(round(until / dt))
    shaken = k + jitter * np.random.default_rng(seed).uniform(-1, 1, len(k)) * (k > 0)
    return np.round(1e9 * dt * shaken).astype(np.int64)


def without(ns: np.ndarray, *gaps: tuple[float, float]) -> np.ndarray:
    """Stamps outside the `gaps` [s]."""
    return ns[~np.any([(ns > 1e9 * start) & (ns < 1e9 * end) for start, end in gaps], axis=0)]


def logged(folder: Path, name: str, sources: list[bags.Source], **changes) -> Log:
    path, columns = bags.recorded(folder, name, sources)
    return read_log([path], replace(load_columns(columns), **changes))


@pytest.mark.parametrize("name", bags.WRITERS)
def test_mixed_rates_a_jittering_clock_and_gaps(tmp_path, name):
    """IMU at 100 Hz with a gap from 6 s, odometry at 50 Hz with one from 2 s, commands at 25 Hz with one from 4 s."""
    odom = without(every(0.02, jitter=0.1, seed=1), (2.01, 2.29))
    imu = without(every(0.01, jitter=0.1, seed=2), (6.0, 6.5))
    late = np.random.default_rng(3).integers(20_000_000, 27_000_000, len(imu))
    log = logged(tmp_path, name, bags.drive(odom, imu, without(every(0.04), (4.0, 4.4)), late))
    assert len(log.runs) == 3 and all(run.dt == pytest.approx(0.01, rel=1e-3) for run in log.runs)
    starts, ends = zip(*((run.t[0], run.t[-1]) for run in log.runs), strict=True)
    np.testing.assert_allclose(starts, [0, 4.4, 6.5], atol=0.012)
    np.testing.assert_allclose(ends, [4.03, 6.0, 9.0], atol=0.012)  # the last command before a gap lasts for 40 ms
    for run in log.runs:
        true = bags.signals(run.t)
        np.testing.assert_allclose(run.r[:-1], true["r"][:-1], atol=1e-4)
        np.testing.assert_allclose(run.extra["ay"][:-1], true["ay"][:-1], atol=1e-3)
        gap = (run.t > 2.03) & (run.t < 2.27)
        assert np.isnan(run.V[gap]).all() and np.isnan(run.extra["x"][gap]).all()
        there = np.isfinite(run.V)
        there[-1] = False  # may lie half a sample time past the last sample
        assert there[:-1][((run.t < 1.98) | (run.t > 2.31))[:-1]].all()
        for ours, theirs, size in ((run.V, np.hypot(true["vx"], true["vy"]), 4e-4), (run.extra["x"], true["x"], 2e-3),
                                   (run.extra["psi"], true["psi"], 2e-4)):  # fmt: skip
            np.testing.assert_allclose(ours[there], theirs[there], atol=size)
        since = run.t - 0.04 * np.floor(run.t / 0.04)
        inside = (since > 0.011) & (since < 0.029)  # there neither jitter nor the even time base can tell
        commanded = bags.signals(run.t - since)
        np.testing.assert_allclose(run.delta[inside], commanded["delta"][inside], atol=1e-12)
        np.testing.assert_allclose(run.Fxr[inside], 2 * commanded["force"][inside], atol=1e-9)
    assert any("100 Hz" in note and "imu" in note for note in log.notes)


def csv_twin(path: Path, ns: np.ndarray, lost: dict[str, np.ndarray]) -> Path:
    """The drive as CSV in the log format, without the values `lost` of each source."""
    values = bags.signals(ns / 1e9)
    columns = {"t": ns / 1e9, "vx": values["vx"], "vy": values["vy"], "psi": values["psi"], "x": values["x"]}
    columns |= {"r": values["r"], "ay": values["ay"], "delta": values["delta"], "Fxr": 2 * values["force"]}
    for names, rows in ((("vx", "vy", "psi", "x"), lost["odom"]), (("delta", "Fxr"), lost["command"])):
        for name in names:
            columns[name][rows] = np.nan
    cells = zip(*columns.values(), strict=True)
    rows = [",".join("" if np.isnan(cell) else repr(float(cell)) for cell in row) for row in cells]
    path.write_text("\n".join([",".join(columns), *rows]))
    return path


@pytest.mark.parametrize("name", bags.WRITERS)
def test_the_same_drive_as_csv_gives_the_same_log(tmp_path, name):
    ns = np.delete(every(0.01, 8.0, jitter=0.08), [333, 334, *range(600, 650)])
    lost = {"odom": np.array([50, *range(100, 120)]), "command": np.array([150, 151, *range(200, 220)])}
    kept = {source: np.delete(ns, rows) for source, rows in lost.items()}
    expected = read_log([csv_twin(tmp_path / "csv.csv", ns, lost)])
    log = logged(tmp_path, name, bags.drive(kept["odom"], ns, kept["command"]), base="r")
    assert len(log.runs) == len(expected.runs) == 3
    for ours, theirs in zip(log.runs, expected.runs, strict=True):
        assert ours.dt == theirs.dt and ours.extra.keys() == theirs.extra.keys()
        for name_ in ("t", "V", "beta", "r", "delta", "Fxr"):
            np.testing.assert_allclose(getattr(ours, name_), getattr(theirs, name_), atol=1e-9, err_msg=name_)
        turns = np.round((ours.extra["psi"] - theirs.extra["psi"]) / (2 * np.pi))
        assert np.nanmin(turns) == np.nanmax(turns)  # whole turns of a heading say nothing
        for key, values in theirs.extra.items():
            turned = 2 * np.pi * turns if key == "psi" else 0.0
            np.testing.assert_allclose(ours.extra[key] - turned, values, atol=1e-9, err_msg=key)


@pytest.mark.parametrize("name", ["ros2", "log.mf4"])
def test_the_base_is_the_channel_that_the_map_names(tmp_path, name):
    sources = bags.drive(every(0.02), every(0.01), every(0.04))
    for base, dt in ((None, 0.01), ("r", 0.01), ("vx", 0.02), ("delta", 0.04)):
        (run,) = logged(made(tmp_path / f"{base}"), name, sources, base=base).runs
        assert run.dt == pytest.approx(dt)
        np.testing.assert_allclose(run.r, bags.signals(run.t)["r"], atol=1e-9)


def made(folder: Path) -> Path:
    folder.mkdir()
    return folder


@pytest.mark.parametrize("name", bags.MESSAGES)
def test_time_stamps_are_those_of_headers_or_of_receipt(tmp_path, name):
    """The IMU's messages are 40 ms late: by receipt its signal comes as much later than the odometry's."""
    sources = bags.drive(every(0.02), every(0.01), every(0.04), late=40_000_000)
    (by_header,) = logged(made(tmp_path / "a"), name, sources).runs
    (by_receipt,) = logged(made(tmp_path / "b"), name, sources, stamps="receipt").runs
    np.testing.assert_allclose(by_header.r, bags.signals(by_header.t)["r"], atol=1e-9)
    np.testing.assert_allclose(by_receipt.r, bags.signals(by_receipt.t - 0.04)["r"], atol=1e-9)
    np.testing.assert_allclose(by_receipt.extra["x"], 10 * by_receipt.t, atol=1e-9)


def test_only_topics_that_the_map_names_are_decoded(tmp_path):
    sources = bags.drive(every(0.02, 1.0), every(0.01, 1.0), every(0.04, 1.0))
    encode = lambda one, content: b"no message" if one.topic == "/camera" else bags.json.dumps(content).encode()
    camera = bags.Source("/camera", "sensor_msgs/msg/Image", every(0.1, 1.0), {"data": np.zeros(10)})
    path, columns = tmp_path / "log.mcap", tmp_path / "map.yaml"
    columns.write_text(bags.MESSAGE_MAP)
    bags.write_mcap_plain(path, [*sources, camera], ("json", "jsonschema"), lambda one: b"{}", encode)
    assert read_log([path], load_columns(columns)).rows == 100


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"compression": bags.CompressionType.LZ4}])
def test_mcap_files_without_an_index_or_otherwise_compressed(tmp_path, options):
    sources = bags.drive(every(0.02, 1.0), every(0.01, 1.0), every(0.04, 1.0))
    (tmp_path / "map.yaml").write_text(bags.MESSAGE_MAP)
    path = bags.write_mcap_json(tmp_path / "log.mcap", sources, **options)
    assert read_log([path], load_columns(tmp_path / "map.yaml")).rows == 100


def test_the_heading_of_any_orientation(tmp_path):
    ns = every(0.01, 2.0)
    yaw = 3 + 0.5 * np.sin(ns / 1e9)
    x, y, z, w = 2 * Rotation.from_euler("ZYX", np.stack([yaw, 0 * yaw + 0.2, 0 * yaw - 0.1], axis=1)).as_quat().T
    unset = np.isin(np.arange(len(ns)), [7, 8])  # zeros stand for no orientation
    odom, *others = bags.drive(ns, ns, ns)
    del odom.columns["pose.pose.orientation.yaw"]
    odom.columns.update({f"pose.pose.orientation.{n}": np.where(unset, 0, q) for n, q in zip("xyzw", (x, y, z, w))})  # noqa: B905
    (run,) = logged(tmp_path, "ros2", [odom, *others]).runs
    assert np.isnan(run.extra["psi"][unset]).all()
    np.testing.assert_allclose(run.extra["psi"][~unset], yaw[~unset], atol=1e-9)


def test_what_json_and_protobuf_leave_out_is_missing(tmp_path):
    ns = every(0.01, 2.0)
    sources = bags.drive(ns, ns, ns)
    for name in ("json.mcap", "protobuf.mcap"):
        folder = made(tmp_path / name)
        (folder / "map.yaml").write_text(bags.MESSAGE_MAP)
        imu = replace_message(sources[1], at=9, drop="angular_velocity")
        path = bags.WRITERS[name](folder / name, [sources[0], imu, *sources[2:]])
        (run,) = read_log([path], load_columns(folder / "map.yaml")).runs
        assert np.flatnonzero(np.isnan(run.r)).tolist() == [9]


def replace_message(source: bags.Source, at: int, drop: str) -> bags.Source:
    """The source with field `drop` left out of one message."""

    class Lacking(bags.Source):
        def messages(self):
            for i, (received, content) in enumerate(super().messages()):
                yield received, {k: v for k, v in content.items() if i != at or k != drop}

    return Lacking(*source)


def test_a_heading_in_degrees_is_unwrapped_by_its_factor(tmp_path):
    ns = every(0.02, 4.0)
    values = bags.signals(ns / 1e9)
    columns = {"heading": np.rad2deg(np.angle(np.exp(1j * values["psi"]))), "vx": values["vx"], "vy": values["vy"]}
    with MDF() as mdf:
        mdf.append([Signal(y, ns / 1e9, name=name) for name, y in columns.items()], acq_name="pose")
        fast = every(0.01, 4.0)
        r = bags.signals(fast / 1e9)
        mdf.append([Signal(r[name], fast / 1e9, name=name) for name in ("r", "delta", "force")], acq_name="imu")
        mdf.save(tmp_path / "log.mf4")
    text = "columns: {t: time, vx: vx, vy: vy, r: r, delta: delta, Fxr: force, psi: {column: heading, factor: %r}}"
    (tmp_path / "map.yaml").write_text(text % (np.pi / 180))
    (run,) = read_log([tmp_path / "log.mf4"], load_columns(tmp_path / "map.yaml")).runs
    there = run.t < 3.97
    np.testing.assert_allclose(run.extra["psi"][there], bags.signals(run.t)["psi"][there], atol=1e-4)


@pytest.mark.parametrize("version", ["3.30", "4.20"])
def test_mdf_of_other_versions_with_groups_enumerations_and_invalid_samples(tmp_path, version):
    ns = every(0.01, 2.0)
    sources = bags.drive(ns, ns, ns)
    suffix = "mdf" if version < "4" else "mf4"
    path = bags.write_mdf(tmp_path / f"log.{suffix}", sources, version)
    with MDF(path) as mdf:
        number = len(mdf.groups)
        t, r = ns / 1e9, 2 * bags.signals(ns / 1e9)["r"]
        invalid = (np.arange(len(t)) == 5) if version > "4" else None
        words = {"val_0": 2, "text_0": "second", "default": ""}
        gear = Signal(np.full(len(t), 2, np.uint8), t, name="gear", conversion=words)
        mdf.append([Signal(r, t, name="r", invalidation_bits=invalid), gear], acq_name="other", common_timebase=True)
        mdf.save(tmp_path / f"two.{suffix}")
    (tmp_path / "map.yaml").write_text(
        bags.MDF_MAP.replace("r: r", f"r: {number}:r").replace("where: {", "where: {gear: 2, ")
    )
    (run,) = read_log([tmp_path / f"two.{suffix}"], replace(load_columns(tmp_path / "map.yaml"), base="vx")).runs
    lost = np.flatnonzero(np.isnan(run.r)).tolist()
    assert lost == ([5] if version > "4" else [])
    np.testing.assert_allclose(np.delete(run.r, lost), np.delete(r, lost)[: len(run.t)], atol=1e-9)


def test_a_bag_without_definitions_is_read_with_those_of_humble(tmp_path):
    path, columns = bags.recorded(tmp_path, "ros2", bags.drive(every(0.02), every(0.01), every(0.04)))
    (database,) = path.glob("*.db3")
    with sqlite3.connect(database) as connection:  # as rosbag2 wrote it before Iron
        connection.execute("UPDATE schema SET schema_version = 3")
        connection.execute("DROP TABLE message_definitions")
    connection.close()
    log = read_log([path], load_columns(columns))
    assert log.rows == 900 and any("'/odom'" in note and "Humble" in note for note in log.notes)


def test_the_kind_is_detected_by_content_and_the_hash_covers_what_is_there(tmp_path):
    sources = bags.drive(every(0.02), every(0.01), every(0.04))
    for name in ("ros1.bag", "json.mcap", "log.mf4"):
        path, columns = bags.recorded(tmp_path, name, sources)
        other = path.rename(tmp_path / f"{name}.csv")
        log = read_log([other], load_columns(columns))
        assert log.rows == 900 and log.sha256 == hashlib.sha256(other.read_bytes()).hexdigest()
    path, columns = bags.recorded(tmp_path, "ros2", sources)
    content = b"".join(file.read_bytes() for file in sorted(path.iterdir()))
    assert read_log([path], load_columns(columns)).sha256 == hashlib.sha256(content).hexdigest()
    (database,) = path.glob("*.db3")
    assert read_log([database], load_columns(columns)).rows == 900


@pytest.mark.parametrize("name", ["ros2", "ros1.bag", "log.mf4"])
def test_inspect_takes_a_recording(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    path, columns = bags.recorded(tmp_path, name, bags.drive(every(0.02), every(0.01), every(0.04)))
    assert main(["inspect", str(path), "--columns", str(columns), "--out", "out"]) == 0
    assert "at 100 Hz" in capsys.readouterr().out and (tmp_path / "out" / "inspection.json").is_file()
    assert main(["inspect", str(path), "--out", "none"]) == 2
    said = capsys.readouterr().err
    assert "needs a column map" in said and "Traceback" not in said


def test_the_map_of_the_documentation_is_read(tmp_path):
    text = (Path(__file__).parents[2] / "docs/how-to/own-log.md").read_text(encoding="utf-8")
    blocks = [block.split("```")[0] for block in text.split("```yaml")[1:]]
    (tmp_path / "map.yaml").write_text(next(block for block in blocks if "/odom." in block))
    ns = every(0.01, 2.0)
    odom, imu, command, enabled = bags.drive(ns, ns, ns)
    imu.columns["linear_acceleration.x"] = np.sin(ns / 1e9)
    driven = {"drive.steering_angle": command.columns["data"][:, 0], "drive.acceleration": np.cos(ns / 1e9)}
    command = command._replace(columns=driven)
    path = bags.write_mcap_json(tmp_path / "log.mcap", [odom, imu, command, enabled])
    (run,) = read_log([path], load_columns(tmp_path / "map.yaml")).runs
    np.testing.assert_allclose(run.Fxr, 1500 * np.cos(run.t), atol=1e-6)


def test_the_latest_sample_holds_over_few_lost_ones_only():
    t, y = np.array([0.0, 0.1, 0.5, 1.0]), np.array([1.0, 2.0, 3.0, 4.0])
    times = np.array([-0.1, 0.0, 0.05, 0.0999999, 0.3, 0.49, 0.55, 0.61, 0.99, 1.05, 1.2])
    expected = [np.nan, 1, 1, 2, 2, 2, 3, np.nan, np.nan, 4, np.nan]
    np.testing.assert_array_equal(sampling.sample_and_hold(times, t, y, 0.1, lost=3), expected)
    np.testing.assert_array_equal(sampling.sample_and_hold(times, t, y, 0.1), [np.nan, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4])


def test_between_samples_is_nothing_where_they_are_lost_or_have_ended():
    t, y = np.array([0.0, 0.1, 0.2, 0.5, 0.6]), np.array([0.0, 1.0, 3.0, 6.0, np.nan])
    times = np.array([-0.05, 0.0, 0.05, 0.1995, 0.2, 0.35, 0.499999, 0.55, 0.6, 0.65])
    expected = [np.nan, 0, 0.5, 3, 3, np.nan, 6, np.nan, np.nan, np.nan]
    np.testing.assert_allclose(sampling.interpolate(times, t, y, 0.1), expected, atol=1e-12)
    np.testing.assert_array_equal(sampling.interpolate(np.array([0.25, 0.3]), t[:3], y[:3], 0.1), [np.nan, np.nan])


def test_the_sample_time_is_one_that_occurs():
    t = np.cumsum([0.0, 0.001, 0.039, 0.001, 0.039])
    assert sampling.sample_time(t) in (0.001, 0.039)
