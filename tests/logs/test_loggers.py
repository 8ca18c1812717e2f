"""Logs of MoTeC, RaceLogic, AiM and CarMaker give the lap that was driven, whatever their rates, units and signs."""

from dataclasses import replace

import loggers
import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.logs import read_log
from driftjax.logs.columns import load_columns
from driftjax.logs.geodesy import east_north

TOLERANCES = {"V": 3e-4, "beta": 2e-6, "r": 2e-4, "delta": 1e-3, "Fxr": 1e-3, "ay": 2e-3, "x": 0.03, "y": 0.03}


@pytest.mark.parametrize("name", loggers.WRITERS)
def test_the_lap_is_read_as_it_was_driven(tmp_path, name):
    path, columns = loggers.logged(tmp_path, name)
    log = read_log(path, str(columns))
    (run,) = log.runs
    assert run.dt == pytest.approx(0.05 if name == "lap.vbo" else 0.01)
    true = loggers.signals(run.t - run.t[0])
    for channel, values in ({"V": run.V, "beta": run.beta, "r": run.r} | run.extra).items():
        there = np.isfinite(values)
        assert there[: int(0.98 * len(there))].all(), channel
        np.testing.assert_allclose(values[there], true[channel][there], atol=TOLERANCES[channel], err_msg=channel)
    period = 0.02 if name in ("lap.ld", "lap.xrk") else run.dt
    held = loggers.signals(period * np.floor((run.t - run.t[0] + 1e-6) / period))
    for channel, values in {"delta": run.delta, "Fxr": run.Fxr}.items():  # commands keep their last value
        np.testing.assert_allclose(values, held[channel], atol=TOLERANCES[channel], err_msg=channel)
    assert any("latitude 49.33" in note for note in log.notes) or name == "lap.erg"


def test_a_deflated_aim_log(tmp_path):
    _, columns = loggers.logged(tmp_path, "lap.xrk")
    run = read_log(loggers.write_xrk(tmp_path / "other.xrz"), str(columns)).runs[0]
    np.testing.assert_allclose(run.r, loggers.signals(run.t)["r"], atol=1e-6)


def test_a_big_endian_result(tmp_path):
    _, columns = loggers.logged(tmp_path, "lap.erg")
    run = read_log(loggers.write_erg(tmp_path / "other.erg", order="BigEndian"), str(columns)).runs[0]
    np.testing.assert_allclose(run.r, loggers.signals(run.t)["r"], atol=1e-9)


def test_positions_are_metres_east_and_north_of_the_origin(tmp_path):
    path, columns = loggers.logged(tmp_path, "lap.vbo")
    there = load_columns(columns)
    assert there.position_from is not None
    moved = replace(there, position_from=replace(there.position_from, origin=(49.329, 8.57)))
    first, second = read_log(path, there).runs[0], read_log(path, moved).runs[0]
    np.testing.assert_allclose(second.extra["x"], first.extra["x"], atol=2e-3)
    np.testing.assert_allclose(second.extra["y"] - first.extra["y"], 111.2174, atol=2e-3)  # m in 1e-3 deg there
    west = replace(there, position_from=replace(there.position_from, west_positive=True))
    np.testing.assert_allclose(read_log(path, west).runs[0].extra["x"], -first.extra["x"], atol=1e-6)


def test_metres_agree_with_lengths_of_degrees_on_the_ellipsoid():
    """Lengths of a degree of latitude and of longitude in WGS 84 (NGA, Length of a degree calculator)."""
    for latitude, north, east in ((0.0, 110574.0, 111320.0), (45.0, 111132.0, 78847.0), (60.0, 111412.0, 55800.0)):
        step = 1e-3
        x, y = east_north(np.array([latitude + step, latitude]), np.array([7.0, 7.0 + step]), (latitude, 7.0))
        np.testing.assert_allclose([y[0], x[1]], [step * north, step * east], rtol=2e-5)
        np.testing.assert_allclose([x[0], y[1]], 0.0, atol=1e-2)


def test_a_position_is_given_once_and_lies_on_the_earth(tmp_path):
    path, columns = loggers.logged(tmp_path, "lap.vbo")
    there = load_columns(columns)
    assert there.position_from is not None
    wrong = replace(there, position_from=replace(there.position_from, factor=60.0))
    with pytest.raises(BadInput, match="row 30: column 'lat' is 2959.8 deg with the factor 60"):
        read_log(path, wrong)
    columns.write_text(columns.read_text().replace("r: yaw", "r: yaw\n  x: height"))
    with pytest.raises(BadInput, match="x or y is in 'columns' and in 'position_from'"):
        load_columns(columns)
