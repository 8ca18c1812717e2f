"""Whatever cannot be read of a recording is reported in one sentence that names it and what to do."""

import re
import sqlite3
import sys
from dataclasses import replace
from pathlib import Path

import bags
import numpy as np
import pytest
from asammdf import MDF, Signal

from driftjax.cli import main
from driftjax.core import BadInput
from driftjax.logs import read_log
from driftjax.logs.columns import ColumnMap, load_columns

NS = (1e7 * np.arange(200)).astype(np.int64)
MANY = {
    "ros1.bag": ("ros", "rosbags.rosbag1"),
    "ros2": ("ros", "rosbags.rosbag2"),
    "json.mcap": ("mcap", "mcap.reader"),
    "protobuf.mcap": ("mcap", "mcap_protobuf.decoder"),
    "log.mf4": ("mdf", "asammdf"),
}


@pytest.fixture
def sources() -> list[bags.Source]:
    return bags.drive(NS, NS, NS)


def map_with(folder: Path, old: str = "", new: str = "", text: str = bags.MESSAGE_MAP) -> ColumnMap:
    assert old in text
    (folder / "map.yaml").write_text(text.replace(old, new))
    return load_columns(folder / "map.yaml")


def assert_rejected(path: Path, columns: ColumnMap | None, sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence) as error:
        read_log([path], columns)
    said = str(error.value)
    assert said.startswith(str(path)) and said.endswith(".") and "\n" not in said and said.count(". ") == 0


COLUMNS = {
    "topic": ("/odom.twist.twist.linear.x", "/odon.twist.twist.linear.x", r"'/odon\.twist.*such as '/odom'"),
    "no field": ("/odom.twist.twist.linear.x", "/odom", r"'/odom' names no topic there and a field"),
    "a list without a number": ("/command.data[0]", "/command.data[first]", r"is no topic\.field; write it as"),
    "field": ("/odom.twist.twist.linear.x", "/odom.twist.twist.liner.x",
              r"'/odom\.twist\.twist\.liner\.x' is not there; '/odom\.twist\.twist' has 'linear'"),
    "field of a number": ("/odom.twist.twist.linear.x", "/odom.twist.twist.linear.x.y", r"linear\.x' has no parts"),
    "yaw of no orientation": ("pose.orientation.yaw", "pose.position.yaw", r"'/odom\.pose\.pose\.position' has '"),
    "message": ("/odom.twist.twist.linear.x", "/odom.twist.twist", r"has parts; map one, such as '.*twist\.linear'"),
    "list": ("/command.data[0]", "/command.data", r"has parts; map one, such as '/command\.data\[0\]'"),
    "item": ("/command.data[0]", "/command.data[2]", r"'/command\.data\[2\]' is not there; '/command\.data' is a list"),
}  # fmt: skip


@pytest.mark.parametrize("case", COLUMNS)
@pytest.mark.parametrize("name", ["ros1.bag", "ros2", "ros2.mcap", "json.mcap", "protobuf.mcap"])
def test_topics_and_fields_that_are_not_there(tmp_path, sources, name, case):
    old, new, sentence = COLUMNS[case]
    assert_rejected(bags.WRITERS[name](tmp_path / name, sources), map_with(tmp_path, old, new), sentence)


@pytest.mark.parametrize("name", bags.WRITERS)
def test_a_recording_without_a_column_map(tmp_path, sources, name):
    path, _ = bags.recorded(tmp_path, name, sources)
    assert_rejected(path, None, "needs a column map.*" + ("'delta'" if name == "log.mf4" else "'/command'"))


@pytest.mark.parametrize("name", MANY)
def test_a_missing_library_is_reported_with_its_extra(tmp_path, sources, name, monkeypatch):
    path, columns = bags.recorded(tmp_path, name, sources)
    extra, module = MANY[name]
    monkeypatch.setitem(sys.modules, module, None)
    assert_rejected(path, load_columns(columns), rf"driftjax\[{extra}\]")


@pytest.mark.parametrize("name", bags.WRITERS)
def test_a_file_that_was_cut_off(tmp_path, sources, name):
    path, columns = bags.recorded(tmp_path, name, sources)
    file = path if path.is_file() else max(path.iterdir(), key=lambda one: one.stat().st_size)
    content = file.read_bytes()
    for share in (0.02, 0.3, 0.6, 0.9):
        file.write_bytes(content[: int(share * len(content))])
        assert_rejected(path, load_columns(columns), "is no readable (ROS bag|MCAP file|MDF file) .*; (mend|write) it")


@pytest.mark.parametrize("name", ["ros1.bag", "json.mcap", "log.mf4"])
def test_a_damaged_file_ends_with_exit_code_2(tmp_path, sources, name, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    path, columns = bags.recorded(tmp_path, name, sources)
    path.write_bytes(path.read_bytes()[:3000])
    assert main(["inspect", str(path), "--columns", str(columns)]) == 2
    said = capfd.readouterr().err
    assert str(path) in said and "Traceback" not in said and "asammdf -" not in said
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("name", bags.MESSAGES)
def test_nothing_recorded(tmp_path, sources, name):
    path = bags.WRITERS[name](tmp_path / name, [])
    assert_rejected(path, map_with(tmp_path), "holds no messages|is no readable")
    silent = sources[0]._replace(ns=NS[:0], columns={})
    if name not in ("protobuf.mcap", "ros2.mcap"):  # their libraries write no topic without a message
        bags.WRITERS[name](tmp_path / f"2{name}", [silent, *sources[1:]])
        assert_rejected(tmp_path / f"2{name}", map_with(tmp_path), "topic '/odom' has no messages; record it")


@pytest.mark.parametrize("name", ["ros1.bag", "ros2", "ros2.mcap", "json.mcap", "protobuf.mcap"])
def test_values_that_are_no_use(tmp_path, sources, name):
    text = bags.Source("/name", "std_msgs/msg/String", NS, {"data": np.full(len(NS), "fast")}, header=False)
    path = bags.WRITERS[name](tmp_path / name, [*sources, text])
    assert_rejected(
        path, map_with(tmp_path, "/imu.angular_velocity.z", "/name.data"), "'/name.data' holds text, such as 'fast'"
    )
    speed = sources[0].columns["twist.twist.linear.x"].copy()
    speed[41] = np.inf
    odom = sources[0]._replace(columns=sources[0].columns | {"twist.twist.linear.x": speed})
    if name != "protobuf.mcap":  # its JSON has no infinity
        path = bags.WRITERS[name](tmp_path / f"2{name}", [odom, *sources[1:]])
        assert_rejected(
            path, map_with(tmp_path), "sample 42 of '/odom': column '/odom.twist.twist.linear.x' is infinite"
        )
    path = bags.WRITERS[name](tmp_path / f"3{name}", [sources[0]._replace(ns=NS[:1]), *sources[1:]])
    assert_rejected(path, map_with(tmp_path), "'/odom', which column .* has 1 samples, fewer than 2")


@pytest.mark.parametrize("name", ["ros1.bag", "ros2.mcap", "json.mcap", "protobuf.mcap"])
def test_time_stamps_that_cannot_be_right(tmp_path, sources, name):
    odom, imu, *others = sources
    shift = np.full(len(NS), 2_000_000_000)
    twin = NS.copy()
    twin[60] = twin[59]
    cases = (
        (
            imu._replace(ns=NS - shift, late=shift),
            "'/odom' was received 0 s .* but '/imu' 2 s after, as if by two clocks",
        ),
        (imu._replace(ns=twin, late=NS - twin), "sample 61 of '/imu': its time stamp, 0.590000 s, is no later than"),
        (imu._replace(ns=NS * 0 - bags.START, late=NS + bags.START), "not all headers of '/imu' hold a time stamp"),
    )
    for i, (changed, sentence) in enumerate(cases):
        path = bags.WRITERS[name](tmp_path / f"{i}{name}", [odom, changed, *others])
        assert_rejected(path, map_with(tmp_path), sentence)
        assert read_log([path], replace(map_with(tmp_path), stamps="receipt")).rows == len(NS)


def test_ros_messages_that_nobody_defines(tmp_path, sources):
    path, columns = bags.recorded(tmp_path, "ros2", sources)
    (database,) = path.glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE schema SET schema_version = 3")
        connection.execute("DROP TABLE message_definitions")
        connection.execute("UPDATE topics SET type = 'my_msgs/msg/Odometry' WHERE name = '/odom'")
    connection.close()
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("nav_msgs/msg/Odometry", "my_msgs/msg/Odometry"))
    assert_rejected(
        path, load_columns(columns), "does not define the messages of '/odom', my_msgs/msg/Odometry; convert it"
    )


def test_mcap_messages_in_other_encodings(tmp_path, sources):
    for encoding, schema in (("cbor", ""), ("cdr", "omgidl")):
        path = tmp_path / f"{encoding}.mcap"
        bags.write_mcap_plain(path, sources, (encoding, schema), lambda one: b"", lambda one, content: b"")
        assert_rejected(
            path, map_with(tmp_path), f"topic '/odom' are in {encoding}, described by {schema}; those that can"
        )


def test_mdf_channels_that_are_no_use(tmp_path, sources):
    t = NS / 1e9
    word, pair = np.full(len(t), b"fast"), np.rec.fromarrays([t, t], dtype=[("a", float), ("b", float)])
    with MDF() as mdf:
        mdf.append([Signal(t, t, name="vx"), Signal(word, t, name="word", encoding="utf-8")], acq_name="A")
        mdf.append([Signal(t, t, name="vx")], acq_name="B")
        mdf.append([Signal(t[:0], t[:0], name="none")])
        mdf.append([Signal(pair, t, name="pair")])
        mdf.save(tmp_path / "log.mf4")
    text = "columns: {t: time, vx: CHANNEL, vy: A:vx, r: A:vx, delta: A:vx, Fxr: A:vx}"
    for channel, sentence in {
        "vz": "has no channel 'vz'; it has 'vx'",
        "C:vx": "has no channel 'C:vx'",
        "vx": r"channel 'vx' is there 2 times; write one of '0:vx' \(A\), '1:vx' \(B\)",
        "word": "channel 'word' holds text; map a channel that is one number",
        "pair": "channel 'pair' holds several values at a time",
        "none": "'2:none', which column 'none' is read from, has 0 samples",
    }.items():
        assert_rejected(tmp_path / "log.mf4", map_with(tmp_path, "CHANNEL", channel, text), sentence)


def test_an_mdf_that_was_not_finished(tmp_path, sources):
    path, columns = bags.recorded(tmp_path, "log.mf4", sources)
    path.write_bytes(b"UnFinMF " + path.read_bytes()[8:])
    assert_rejected(path, load_columns(columns), "the recorder did not finish the MDF file; finalise it")


def test_folders_that_are_no_bag(tmp_path, sources):
    path, columns = bags.recorded(tmp_path, "ros2", sources)
    assert_rejected(tmp_path, load_columns(columns), "is a folder without the metadata.yaml of a ROS 2 bag")
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 9}\n")
    assert_rejected(path, load_columns(columns), "is no readable ROS bag .*; mend it")
    (path / "metadata.yaml").write_text("{")
    assert_rejected(path, load_columns(columns), "is no readable ROS bag")


def test_maps_that_make_no_sense_for_a_recording(tmp_path, sources):
    for key, sentence in (
        ("base: ax", "key 'base' is 'ax'; it must be a channel that 'columns' maps"),
        ("base: t", "key 'base' is 't'"),
        ("stamps: header.stamp", "key 'stamps' is 'header.stamp'; choose one of header, receipt"),
    ):
        with pytest.raises(BadInput, match=re.escape(sentence)):
            map_with(tmp_path, "columns:", f"{key}\ncolumns:")
    path, _ = bags.recorded(tmp_path, "ros2", sources)
    nothing = "columns: {t: time, vx: time, vy: time, r: time, delta: time, Fxr: time}"
    assert_rejected(
        path, map_with(tmp_path, text=nothing), "the column map says that vx is 'time', the time stamps; only t can"
    )
