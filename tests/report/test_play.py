"""`driftjax play`: the page in a browser, the cars as MCAP, GIF and MP4; what a page leaves out."""

import base64
import webbrowser

import matplotlib.animation
import numpy as np
import pytest
from diagnosed import diagnosed
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image, ImageSequence
from synthetic import synthetic_run

from driftjax.cli import main
from driftjax.report import player
from driftjax.report.animation import add_car
from driftjax.report.drives import CarDrive, integrated_pose, lap_drives
from driftjax.report.html import embedded_json, pack
from driftjax.report.player import player_data
from driftjax.report.style import new_figure
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> RunFolder:
    return synthetic_run(tmp_path_factory.mktemp("runs") / "run", 2, ("pursuit", "nominal", "gpr-1", "explore-1"))


def messages(path) -> dict[str, list]:
    """Messages by topic, with their schema."""
    by_topic: dict[str, list] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            by_topic.setdefault(channel.topic, []).append((schema.name, message.log_time / 1e9, decoded))
    return by_topic


def test_mcap_holds_every_step_of_every_car(run, tmp_path, capsys):
    file = tmp_path / "lap.mcap"
    assert main(["play", str(run.path), "--mcap", str(file), "--show", "sedan_0_0"]) == 0
    by_topic = messages(file)
    total = sum(map(len, by_topic.values()))
    assert f"plant sedan_0_0, {total} messages on {len(by_topic)} topics" in capsys.readouterr().out
    steps = int(run.read_stage("explore-1")["alive"].values[0].sum())
    kinds = {"pose": "foxglove.PoseInFrame", "scene": "foxglove.SceneUpdate", "state": "driftjax.State"}
    for car in ("nominal_mpc", "gpr_lap_1", "explored_1"):
        for name, schema in kinds.items():
            assert [len(by_topic[f"/{car}/{name}"]), by_topic[f"/{car}/{name}"][0][0]] == [steps, schema]
        assert len(by_topic[f"/{car}/path"][0][2].poses) == steps
    assert len(by_topic["/tf"]) == 3 * steps and {one[0] for one in by_topic["/tf"]} == {"foxglove.FrameTransform"}
    assert [len(by_topic[name]) for name in ("/track", "/plan")] == [1, 1] and len(
        by_topic["/track"][0][2].entities[0].lines
    ) == 3
    lane, k = run.read_stage("explore-1").isel(lane=0), 77
    _, t, state = by_topic["/explored_1/state"][k]
    pose = by_topic["/explored_1/pose"][k][2].pose
    assert t == pytest.approx(float(lane["t"][k]))
    assert [state.V, state.beta, pose.position.x] == pytest.approx([float(lane[n][k]) for n in ("V", "beta", "x")])
    heading = 2 * np.arctan2(pose.orientation.z, pose.orientation.w)
    assert np.cos(heading - float(lane["psi"][k])) == pytest.approx(1)


def test_frames_of_the_mcap_are_one_tree_and_time_stamps_those_of_the_messages(run, tmp_path):
    """A viewer places an entity by the transform at its time stamp, and lets it vanish a lifetime after that."""
    file = tmp_path / "lap.mcap"
    assert main(["play", str(run.path), "--mcap", str(file)]) == 0
    parents, used = {}, set()
    for _, t, message in (one for topic in messages(file).values() for one in topic):
        for part in (message, *getattr(message, "entities", ())):
            if hasattr(part, "timestamp"):
                assert part.timestamp.ToNanoseconds() == round(t * 1e9)
            used |= {part.frame_id} if hasattr(part, "frame_id") else set()
        assert all(entity.frame_locked for entity in getattr(message, "entities", ()))
        if hasattr(message, "child_frame_id"):
            parents.setdefault(message.child_frame_id, set()).add(message.parent_frame_id)
    assert parents == {"nominal_mpc": {"map"}, "gpr_lap_1": {"map"}, "explored_1": {"map"}}
    assert used == {"map", *parents}
    with file.open("rb") as stream:
        times = [message.log_time for *_, message in make_reader(stream).iter_messages(log_time_order=False)]
    assert times == sorted(times)


def test_what_a_car_lacks_is_not_zero_in_mcap(tmp_path):
    diagnosis, file = diagnosed(tmp_path / "run"), tmp_path / "run.mcap"
    assert main(["play", str(diagnosis.path), "--mcap", str(file)]) == 0
    by_topic = messages(file)
    assert {"/measured/state", "/predicted_nominal/state", "/predicted_extended/scene"} <= set(by_topic)
    assert len(by_topic["/measured/state"]) == 1000 > len(by_topic["/predicted_nominal/state"]) > 500
    assert np.isnan(by_topic["/predicted_nominal/state"][0][2].Fxr) and np.isfinite(
        by_topic["/measured/state"][0][2].Fxr
    )


def test_no_line_joins_the_end_of_a_prediction_to_the_start_of_the_next():
    times = np.arange(0.0, 4.0, 0.25)
    piece = lambda start, x: (
        {"t": np.array([start, start + 1.5]), "x": np.full(2, x)}
        | {name: np.zeros(2) for name in ("y", "psi", "V", "beta", "r")}
    )
    drive = CarDrive("run", "predicted, nominal", "nominal", "", "", [piece(0.0, 1.0), piece(1.5, 9.0)])
    axis, strip = new_figure(1, 2, (4.0, 2.0))[1][0]
    x = add_car(axis, strip, drive, times.tolist(), True).points[:, 0]
    assert {1.0, 9.0} == set(x[np.isfinite(x)])
    assert not any({a, b} == {1.0, 9.0} for a, b in zip(x, x[1:], strict=False))
    assert [handle.get_label() for handle in strip.get_lines()] == ["predicted, nominal"]


def test_gif_has_a_frame_per_step_of_the_corner(run, tmp_path, monkeypatch):
    monkeypatch.setattr("driftjax.report.animation.RATE", 1.0)  # few frames
    file = tmp_path / "lap.gif"
    assert main(["play", str(run.path), "--gif", str(file)]) == 0
    start, end = (run.read_dataset("plan.nc").attrs[f"drift_{edge}"] for edge in ("start", "end"))
    s = run.read_stage("explore-1").isel(lane=0)["s"].values
    with Image.open(file) as image:
        frames = [np.asarray(frame.convert("RGB"), int) for frame in ImageSequence.Iterator(image)]
    assert len(frames) == pytest.approx(((s > start - 15) & (s < end + 12)).sum() * 0.05, abs=1.5)
    assert (np.abs(frames[3] - frames[0]).sum(axis=2) > 60).sum() > 200, "the cars have moved"


def test_mp4_without_ffmpeg_is_one_sentence(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(matplotlib.animation.FFMpegWriter, "isAvailable", classmethod(lambda cls: False))
    assert main(["play", str(run.path), "--mp4", str(tmp_path / "lap.mp4")]) == 2
    assert "needs the program ffmpeg; install it (apt-get install ffmpeg)" in capsys.readouterr().err
    assert not (tmp_path / "lap.mp4").exists()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--gif", "lap.mp4"], "must end in .gif"),
        (["--gif", "nowhere/lap.gif"], "the folder nowhere does not exist"),
        (["--gif", "lap.gif", "--show", "sedan_9"], "choose one of plant sedan_0_0, plant sedan_0_1"),
        (["--show", "sedan_0_0"], "add --mcap, --gif or --mp4"),
    ],
)
def test_bad_flags_are_one_sentence(run, flags, words, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert main(["play", str(run.path), *flags]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def test_play_opens_the_page(run, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)
    (run.path / "report.html").write_text("page")
    assert main(["play", str(run.path)]) == 0
    assert opened == [(run.path / "report.html").as_uri()] and "report.html\n" in capsys.readouterr().out
    monkeypatch.setattr(webbrowser, "open", lambda url: False)
    assert main(["play", str(run.path)]) == 0 and "no browser was found" in capsys.readouterr().out


def test_a_run_of_another_verb_has_nothing_to_play(tmp_path, capsys):
    other = RunFolder.create(tmp_path / "run", {}, "tune")
    for flags, verbs in (([], "learn, diagnose or compare"), (["--gif", str(tmp_path / "a.gif")], "learn or diagnose")):
        assert main(["play", str(other.path), *flags]) == 2
        assert f"take one of {verbs}" in capsys.readouterr().err


def test_a_full_page_leaves_out_stages_before_plants(run, monkeypatch):
    plan = run.read_dataset("plan.nc")
    drives = lap_drives(run, plan)
    whole = player_data(load_vehicle("sedan"), drives, plan)
    assert whole["left_out"] == 0 and len(whole["drives"]) == 14
    monkeypatch.setattr(player, "ROOM", 1)
    least = player_data(load_vehicle("sedan"), drives, plan)
    assert least["left_out"] == 13 and least["drives"][0]["name"] == "nominal MPC"
    assert len(embedded_json(whole)) < 1e6


def test_packed_numbers_come_back_within_half_a_step():
    values = np.array([-3.0, np.nan, 0.1234567, 7.5])
    packed = pack(values)
    levels = np.frombuffer(base64.b64decode(packed["b"]), "<u2")
    assert levels[1] == 65535
    back = packed["low"] + packed["step"] * levels[[0, 2, 3]]
    np.testing.assert_allclose(back, values[[0, 2, 3]], atol=10.5 / 131068 + 1e-12)
    assert pack(np.full(3, np.nan))["low"] == 0.0


def test_a_steady_turn_is_a_circle():
    t = np.linspace(0, 2 * np.pi / 0.5, 2001)
    pose = integrated_pose(t, np.full(t.shape, 10.0), np.full(t.shape, -0.3), np.full(t.shape, 0.5))
    np.testing.assert_allclose([pose["x"][-1], pose["y"][-1]], 0, atol=1e-3)
    assert np.hypot(np.ptp(pose["x"]), np.ptp(pose["y"])) == pytest.approx(np.hypot(40, 40), rel=1e-4)


def test_embedded_json_cannot_end_its_element():
    text = embedded_json({"</script>": "<!-- & -->", "number": float("nan")})
    assert not set("<>&") & set(text) and "null" in text
