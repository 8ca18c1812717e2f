"""A proposed column map: names, units, signs, which of two, and what is left open; the map reads the log."""

import bags
import loggers
import numpy as np
import pytest
import yaml

from driftjax.core import BadInput
from driftjax.logs import guess_columns, read_log
from driftjax.logs.columns import load_columns
from driftjax.logs.guess.log_columns import unwrapped
from driftjax.logs.guess.names import meaning
from driftjax.logs.unit_words import parse_unit

DEG, KMH, G = np.pi / 180, 1 / 3.6, 9.80665
T = np.arange(0, 25, 0.02)


def drive() -> dict[str, np.ndarray]:
    """A winding drive in the log format, consistent to the last digit of a difference."""
    V = 14 + 3 * np.sin(0.4 * T)
    beta = 0.05 * np.sin(0.9 * T + 1)
    r = 0.4 * np.sin(0.7 * T) + 0.1 * np.cos(0.23 * T)
    psi = 0.3 + np.cumsum(r) * 0.02
    course = psi + beta
    dV, dc = np.gradient(V, 0.02), np.gradient(course, 0.02)
    x, y = np.cumsum(V * np.cos(course)) * 0.02, np.cumsum(V * np.sin(course)) * 0.02
    ax, ay = dV * np.cos(beta) - V * dc * np.sin(beta), dV * np.sin(beta) + V * dc * np.cos(beta)
    delta = 2.6 * r / V + 0.002 * np.sin(5 * T)
    return {"t": T, "vx": V * np.cos(beta), "vy": V * np.sin(beta), "V": V, "beta": beta, "r": r, "psi": psi, "x": x,
            "y": y, "ax": ax, "ay": ay, "delta": delta, "Fxr": 1200 * dV + 300}  # fmt: skip


def written(path, columns: dict[str, np.ndarray]):
    rows = zip(*columns.values(), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in rows)]))
    return path


def placed(path, **car) -> dict[str, tuple[str, float, float]]:
    return {one.channel: (one.column, one.factor, one.offset) for one in guess_columns(path, **car).channels}


def test_units_and_signs_follow_from_the_other_channels(tmp_path):
    """Names without units; degrees, km/h and g; yaw rate and steering to the right, a compass heading."""
    d = drive()
    log = {"time": 1e3 * d["t"], "v_long": d["vx"] / KMH, "v_lat": d["vy"] / KMH, "gyro_z": -d["r"] / DEG,
           "heading": np.degrees(np.pi / 2 - d["psi"]) % 360, "pos_x": d["x"], "pos_y": d["y"], "acc_x": d["ax"] / G,
           "acc_y": d["ay"] / G, "steering_angle": -d["delta"] / DEG, "temperature": 20 + 0.1 * np.sin(T)}  # fmt: skip
    got = placed(written(tmp_path / "log.csv", log))
    expected = {"t": ("time", 1e-3, 0.0), "vx": ("v_long", KMH, 0), "vy": ("v_lat", KMH, 0), "r": ("gyro_z", -DEG, 0),
                "psi": ("heading", -DEG, np.pi / 2), "x": ("pos_x", 1, 0), "y": ("pos_y", 1, 0),
                "ax": ("acc_x", G, 0), "ay": ("acc_y", G, 0), "delta": ("steering_angle", -DEG, 0)}  # fmt: skip
    assert got.keys() == expected.keys()
    for channel, (column, factor, offset) in expected.items():
        assert got[channel][0] == column
        assert got[channel][1] == pytest.approx(factor), channel
        assert got[channel][2] % (2 * np.pi) == pytest.approx(offset), channel


def test_of_two_columns_that_which_follows_the_others_is_taken(tmp_path):
    d = drive()
    wrong = np.roll(d["r"], 400) + 0.2 * np.cos(3 * T)
    log = {"t": d["t"], "yaw_rate": d["r"], "yaw_rate_raw": wrong, "vx": d["vx"], "vy": d["vy"], "ay": d["ay"]}
    assert placed(written(tmp_path / "a.csv", log))["r"][0] == "yaw_rate"
    log |= {"yaw_rate": wrong, "yaw_rate_raw": d["r"]}
    assert placed(written(tmp_path / "b.csv", log))["r"][0] == "yaw_rate_raw"


def test_a_delay_is_found(tmp_path):
    d = drive()
    late = np.interp(T - 0.12, T, d["r"])
    path = written(tmp_path / "log.csv", {key: d[key] for key in ("t", "x", "y", "psi", "vx", "vy")} | {"r": late})
    (yaw,) = (one for one in guess_columns(path).channels if one.channel == "r")
    assert yaw.delay == pytest.approx(0.13, abs=0.005)  # the sum of psi is half a sample ahead


def test_the_written_map_reads_the_log(tmp_path):
    d = drive()
    units = {"t": "s", "x": "m", "y": "m", "psi": "rad", "vx": "m/s", "vy": "m/s", "r": "rad/s", "ax": "m/s^2",
             "ay": "m/s^2", "delta": "rad"}  # fmt: skip
    log = {f"{key} [{unit}]": d[key] for key, unit in units.items()}
    path = written(tmp_path / "log.csv", log | {"on": (T > 1).astype(float)})
    guess = guess_columns(path, wheelbase=2.6)
    guess.write(tmp_path / "map.yaml")
    assert load_columns(tmp_path / "map.yaml") == guess.column_map()
    assert "Rows may be chosen by 'on'" in str(guess) and yaml.safe_load(guess.yaml())["columns"]["t"] == "t [s]"
    run = read_log(path, str(tmp_path / "map.yaml")).runs[0]
    np.testing.assert_allclose(run.r, d["r"], atol=1e-6)
    assert np.isnan(run.Fxr).all() and "recognised as Fxr: the force is estimated from the speed" in str(guess)
    with pytest.raises(BadInput, match="map.yaml: is there already"):
        guess.write(tmp_path / "map.yaml")


def test_the_wheelbase_tells_a_steering_wheel_from_a_road_wheel(tmp_path):
    d = drive()
    log = {key: d[key] for key in ("t", "vx", "vy", "r", "ay")} | {"steer_rad": 15 * d["delta"]}
    path = written(tmp_path / "log.csv", log)
    assert placed(path, wheelbase=2.6)["delta"][1] == pytest.approx(1 / 15, rel=0.05)
    assert any("looks like the steering wheel's angle" in one for one in guess_columns(path).open)


@pytest.mark.parametrize("size", [1e10, 6.8e180, 1e308])
def test_absurd_values_do_not_count_as_evidence(tmp_path, size):
    """One of a damaged file: the other values say as much as without it."""
    d = {name: drive()[name] for name in ("t", "V", "beta", "r", "x", "y", "ay", "delta")}
    expected = placed(written(tmp_path / "log.csv", d))
    d["r"][300], d["V"][700] = size, -size
    path = written(tmp_path / "log.csv", d)
    assert placed(path) == expected
    assert "Values of absurd size in 'V', 'r' were not compared." in guess_columns(path).open


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("empty", ["V", "r", "x", "beta", "delta", "ay"])
def test_channels_without_two_values_close_together_are_guessed_without_warnings(tmp_path, empty):
    d = {name: drive()[name] for name in ("t", "V", "beta", "r", "x", "y", "psi", "ay", "delta")}
    d[empty][np.arange(len(T)) % 200 > 0] = np.nan
    assert "t" in placed(written(tmp_path / "log.csv", d))


def test_a_log_of_a_simulator_that_starts_anew(tmp_path):
    """Its heading jumps, the speed is a little negative there, and its accelerometer leaves out the turning."""
    d = {name: drive()[name] for name in ("t", "V", "r", "x", "y", "psi", "ax", "ay", "delta")}
    d["psi"], d["ay"] = d["psi"] % (2 * np.pi), 0.01 * np.cos(9 * T)
    for name, value in {"V": -0.01, "x": 0.0, "y": 0.0, "psi": 0.0, "r": 0.0}.items():
        d[name][-3:] = value
    path = written(tmp_path / "log.csv", d)
    guess = guess_columns(path)
    assert {one.channel for one in guess.channels} == set(d) - {"ay"}
    assert any("'ay' is named like ay but does not follow V r" in one for one in guess.open)
    guess.write(tmp_path / "map.yaml")
    log = read_log(path, str(tmp_path / "map.yaml"))
    assert log.runs[0].V.min() > 1 and len(log.runs[0].t) == len(T) - 3


def test_what_is_missing_is_named(tmp_path):
    d = drive()
    guess = guess_columns(written(tmp_path / "log.csv", {key: d[key] for key in ("t", "V", "r")}))
    assert "No column was recognised as delta, which the diagnosis needs." in guess.yaml()
    assert "No column was recognised as beta: sideslip is inferred from the other channels." in guess.yaml()
    with pytest.raises(BadInput, match="no column was recognised as 'delta'"):
        guess.column_map()
    with pytest.raises(BadInput, match="no column rises like a time"):
        guess_columns(written(tmp_path / "no.csv", {"speed": d["V"], "yaw": d["psi"]}))


@pytest.mark.parametrize("name", ["lap.ld", "lap.vbo", "lap.erg"])
def test_files_of_loggers(tmp_path, name):
    path, columns = loggers.logged(tmp_path, name)
    true = load_columns(columns)
    got = placed(path)
    for channel in true.columns:
        assert got[channel.name][0] == channel.column and got[channel.name][1] == pytest.approx(channel.factor)
    if true.position_from:
        assert got["latitude"][0] == true.position_from.latitude and got["longitude"][1] == pytest.approx(DEG)
    assert "psi" not in got  # the heading of a GPS is the direction of travel


@pytest.mark.parametrize("name", ["ros2", "json.mcap", "log.mf4"])
def test_recordings(tmp_path, name):
    """Commands in an array without names cannot be identified; everything else is."""
    ns = (2e7 * np.arange(400)).astype(np.int64)
    path, columns = bags.recorded(tmp_path, name, bags.drive(ns, ns, ns))
    got = {channel: column for channel, (column, *_) in placed(path).items()}
    wanted = {one.name: one.column for one in load_columns(columns).columns}
    if name != "log.mf4":
        wanted.pop("delta")
    assert {channel: got.get(channel) for channel in wanted} == wanted


@pytest.mark.parametrize(
    ("name", "unit", "channel", "factor"),
    [("Car.YawRate", "rad/s", "r", 1.0), ("yaw_rate_deg_s", "", "r", DEG), ("Speed (km/h)", "", "V", KMH),
     ("G Force Lat", "G", "ay", G), ("imu_ax_mps2", "", "ax", 1.0), ("OxTSData.sideSlip_rad", "", "beta", 1.0),
     ("GPS Longitude", "deg", "longitude", DEG), ("/odom.twist.twist.linear.y", "", "vy", None)],
)  # fmt: skip
def test_names_and_units(name, unit, channel, factor):
    said = meaning(name, unit)
    assert max(said.name_score, key=said.name_score.__getitem__) == channel
    assert (said.unit and said.unit.factor) == (pytest.approx(factor) if factor else None)


def test_units_are_distinguished_from_other_words():
    assert parse_unit("furlong") is None and meaning("car v").unit is None
    assert meaning("yaw_acc_radps2").name_score["r"] == 0 and meaning("a_lat").name_score["latitude"] < 0.1


def test_only_jumps_by_a_turn_are_taken_out_of_an_angle():
    angle = np.linspace(0, 1000, 500)
    np.testing.assert_allclose(unwrapped(angle % 360), angle)
    steps = np.repeat([0.0, 7.0, 0.0, 7.0], 100)
    np.testing.assert_array_equal(unwrapped(steps), steps)
