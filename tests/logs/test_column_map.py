"""Column maps: they convert, filter, thin and name what a foreign log has, and say what does not fit it."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_up import columns, write

from driftjax.core import BadInput
from driftjax.logs import read_log
from driftjax.logs.columns import CHANNELS, Channel, ColumnMap, Condition, Drive, load_columns

LOGS = Path(__file__).parent / "logs"  # small ones in the layouts of the shipped column maps
MAP = """
columns:
  t: {column: millis, factor: 0.001}
  vx: speed
  vy: side
  r: {column: yaw_deg, factor: 0.017453292519943295, offset: 0.1}
  delta: steer
Fxr_from: {column: throttle, factor: 100, factor_per_speed: -2, above: 0.2, times: motor}
run: [day, lap]
where:
  ok: 1
  lap: [one, two]
  speed: {min: 1}
skip_rows: [2]
"""


def foreign(path: Path) -> dict[str, list]:
    rows = range(40)
    values = {
        "day": [7] * 40,
        "lap": ["one"] * 20 + ["two"] * 10 + ["three"] * 10,
        "ok": ["1.0"] * 39 + ["0"],
        "millis": [10 * i for i in rows],
        "speed": [5 + 0.1 * i for i in rows],
        "side": [0.01 * i for i in rows],
        "yaw_deg": list(rows),
        "steer": [0.0] * 40,
        "throttle": [i / 40 for i in rows],
        "motor": [1] * 10 + [0] * 30,
    }
    values["speed"][0] = 0.5
    write(path, values)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], "-,-,-,ms,m/s,m/s,deg/s,rad,1,1", *lines[1:]]))
    return values


def test_a_force_is_the_sum_of_engine_and_brakes(tmp_path):
    plain = columns()
    n = len(plain["t"])
    torque = list(map(float, range(n)))
    write(tmp_path / "log.csv", plain | {"torque": torque, "gear": n * [3.0], "front": n * [1.0], "rear": n * [0.5]})
    force = "[{column: torque, factor: 2, times: gear}, {column: front, factor: -9}, {column: rear, factor: -4}]"
    channels = "columns: {t: t, V: V, r: r, delta: delta}"
    (tmp_path / "map.yaml").write_text(f"{channels}\nFxr_from: {force}\n")
    log = read_log(tmp_path / "log.csv", load_columns(tmp_path / "map.yaml"))
    np.testing.assert_allclose(log.runs[0].Fxr, 6 * np.arange(len(log.runs[0].t)) - 9 - 2)
    assert any("columns 'torque' and 'front' and 'rear' stand for Fxr" in note for note in log.notes)


def test_a_log_without_a_yaw_rate_needs_a_heading(tmp_path):
    ColumnMap(tuple(Channel(one, one) for one in ("t", "V", "delta", "psi")))
    with pytest.raises(BadInput, match=re.escape("nothing to 'r'; add it (or psi)")):
        ColumnMap(tuple(Channel(one, one) for one in ("t", "V", "beta", "delta", "Fxr")))
    channels = {name: values for name, values in columns().items() if name != "r"}
    write(tmp_path / "log.csv", channels)
    with pytest.raises(BadInput, match=re.escape("column 'r' is missing; add it (or psi)")):
        read_log(tmp_path / "log.csv")
    write(tmp_path / "log.csv", channels | {"psi": channels["beta"]})
    log = read_log(tmp_path / "log.csv")
    assert np.isnan(log.runs[0].r).all() and any(
        "has no r; the rate of the heading stands for it" in note for note in log.notes
    )


def test_a_column_map_converts_filters_and_names(tmp_path):
    values = foreign(tmp_path / "log.csv")
    (tmp_path / "map.yaml").write_text(MAP)
    log = read_log([tmp_path / "log.csv"], load_columns(tmp_path / "map.yaml"))
    one, two = log.runs
    assert (one.name, two.name, len(one.t), len(two.t)) == ("7/one", "7/two", 19, 10)
    np.testing.assert_allclose(one.t, 0.01 * np.arange(1, 20))
    vx, vy = np.array(values["speed"])[1:20], np.array(values["side"])[1:20]
    np.testing.assert_allclose(one.V, np.hypot(vx, vy))
    np.testing.assert_allclose(one.r, np.deg2rad(np.arange(1, 20)) + 0.1)
    force = (100 - 2 * vx) * np.maximum(np.arange(1, 20) / 40 - 0.2, 0) * (np.arange(1, 20) < 10)
    np.testing.assert_allclose(one.Fxr, force, atol=1e-12)
    assert any("left out 11 of 40 rows" in note for note in log.notes) and any("'throttle'" in n for n in log.notes)


def test_a_column_map_thins_to_a_rate(tmp_path):
    values = columns()
    path = write(tmp_path / "log.csv", values)
    own = ColumnMap(tuple(Channel(name, name) for name in CHANNELS), rate=20.0)
    (run,) = read_log([path], own).runs
    assert run.dt == pytest.approx(0.05)
    np.testing.assert_array_equal(run.V, values["V"][::5])
    np.testing.assert_allclose(run.delta, np.reshape(values["delta"], (-1, 5)).mean(1))
    slow = write(tmp_path / "slow.csv", columns(dt=0.05))
    assert {run.dt for run in read_log([path, slow], own).runs} == {0.05}
    for rate, choice in ((30.0, "33.33"), (150.0, "100"), (400.0, "100")):
        with pytest.raises(BadInput, match=rf"log\.csv, run 'log': .*100 Hz.* {rate:g} Hz; choose {choice}"):
            read_log([path], replace(own, rate=rate))


def test_a_measured_steering_angle_is_linear_between_samples_and_a_command_is_held(tmp_path):
    values = {name: np.array(column) for name, column in columns().items()}
    values["delta"] = values["Fxr"] = 0.2 * np.sin(5 * values["t"])
    path = write(tmp_path / "log.csv", values)
    own = ColumnMap(tuple(Channel(name, name) for name in CHANNELS), linear=("delta",))
    (run,) = read_log([path], own).runs
    np.testing.assert_array_equal(run.Fxr, values["Fxr"])
    np.testing.assert_allclose(run.delta[:-1], (values["delta"][1:] + values["delta"][:-1]) / 2)
    np.testing.assert_allclose(run.command_changes[1:-2, 0], np.diff(values["delta"])[1:-1], atol=1e-5)
    assert not run.command_changes[:, 1].any()
    (thin,) = read_log([path], replace(own, rate=20.0)).runs
    whole = np.arange(0, len(values["t"]) - 5, 5)
    mean = [np.trapezoid(values["delta"][k : k + 6]) / 5 for k in whole]
    np.testing.assert_allclose(thin.delta[: len(whole)], mean)
    parts = read_log([path], own).split_runs(0.1).runs
    assert {part.linear for part in parts} == {("delta",)} and len(parts) > 1
    with pytest.raises(BadInput, match="key 'linear' has 'V'; it may have delta and Fxr"):
        replace(own, linear=("V",))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("delta: steer", "steer: steer"), "maps 'steer'; the channels are"),
        (("  delta: steer\n", ""), "maps nothing to 'delta'"),
        (("  vy: side\n", ""), "maps one of vx and vy"),
        (("delta: steer", "delta: steer\n  Fxr: throttle"), "Fxr is in 'columns' and 'Fxr_from'"),
        (("factor: 0.001", "factr: 0.001"), "unknown key 'factr'"),
        (("where:", "filter:"), "unknown key 'filter'"),
        (("run:", "rate: 0\nrun:"), "key 'rate' is 0.0; it must be positive"),
        (("Fxr_from: {", "Fxr_from: {wheel: 1, "), "unknown key 'wheel'"),
    ],
)
def test_column_maps_that_make_no_sense_are_reported(tmp_path, change, sentence):
    path = tmp_path / "map.yaml"
    path.write_text(MAP.replace(*change))
    with pytest.raises(BadInput, match=f"^{re.escape(str(path))}: .*{re.escape(sentence)}"):
        load_columns(path)


def test_column_maps_that_do_not_fit_the_file_are_reported(tmp_path):
    foreign(tmp_path / "log.csv")
    (tmp_path / "map.yaml").write_text(MAP)
    fits = load_columns(tmp_path / "map.yaml")
    for columns_, sentence in (
        (replace(fits, where=(Condition("ok", (3.0,)),)), "no row passes the condition on 'ok'"),
        (
            replace(fits, where=(Condition("okay", (1.0,)),)),
            "column 'okay' is missing; add it or correct the column map",
        ),
        (replace(fits, Fxr_from=(Drive("gas"),)), "column 'gas' is missing"),
        (
            replace(fits, columns=tuple(replace(c, factor=1.0) for c in fits.columns)),
            r"column 'millis' \(t\) steps by 10",
        ),
    ):
        with pytest.raises(BadInput, match=rf"log\.csv.*{sentence}"):
            read_log([tmp_path / "log.csv"], columns_)
    with pytest.raises(BadInput, match="shipped columns names: dart_jetracer, dart_onboard, dart_steer_id"):
        load_columns("jetracer")


@pytest.mark.parametrize(
    ("file", "columns", "rate", "samples", "speed", "Fxr"),
    [
        ("dart", "dart_jetracer", 20, [23], 2.0, (25.36 - 4.815 * 2.01) * (0.3 - 0.164)),
        ("dart", "dart_onboard", 10, [12], 2.0, (25.36 - 4.815 * 2.01) * (0.3 - 0.164)),
        ("dart_steer_id", "dart_steer_id", 20, [23], 0.5, (25.36 - 4.815 * 0.5025) * (0.3 - 0.164)),
        ("ferrari", "ferrari_250lm", 50, [40, 55], 30.0, 982 * 0.6),  # cut where its steering sensor fails
        ("genesis", "genesis_g80", 25, [50], 8.0, 2303.1 * 0.16),
    ],
)
def test_logs_of_the_shipped_maps_are_read_as_they_were_made(file, columns, rate, samples, speed, Fxr):
    """What `logs/write.py` writes: a slalom of r = 0.4 sin(wt), vy = -0.02 vx(0) sin(wt), delta = 0.1 sin(wt)."""
    log = read_log([LOGS / f"{file}.csv"], load_columns(columns))
    assert [len(run.t) for run in log.runs] == samples and any("stands for Fxr" in note for note in log.notes)
    for run in log.runs:
        assert run.dt == pytest.approx(1 / rate)
        wave = np.sin(2 * np.pi * 0.25 * run.t)
        vx, vy = speed * (1 + 0.02 * run.t), -0.02 * speed * wave
        inner = slice(1, -1)  # the ends of a run have fewer samples to be thinned from
        np.testing.assert_allclose(run.V[inner], np.hypot(vx, vy)[inner], rtol=2e-3)
        np.testing.assert_allclose(run.beta[inner], np.arctan2(vy, vx)[inner], atol=1e-3)
        np.testing.assert_allclose(run.r[inner], 0.4 * wave[inner], atol=5e-3)
        middle = run.t + (run.dt - 0.01) / 2  # a command is the mean over the sample that it leads
        np.testing.assert_allclose(run.delta[inner], 0.1 * np.sin(2 * np.pi * 0.25 * middle)[inner], atol=1e-3)
        assert run.Fxr[len(run.t) // 2] == pytest.approx(Fxr, rel=5e-3)
