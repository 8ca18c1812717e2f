"""Logs without a yaw rate, which is that of the heading, or without a heading, the integral of the yaw rate."""

import dataclasses

import numpy as np
import pytest

import driftjax as dj
from driftjax.diagnosis.calibrate import select_effects
from driftjax.diagnosis.fit import initial_problem
from driftjax.diagnosis.log_limits import Unidentifiable
from driftjax.diagnosis.resolve import resolved_log

DT = 0.02
T = DT * np.arange(500)
NONE = np.full_like(T, np.nan)


def turning(**extra) -> tuple[dj.Run, np.ndarray]:
    """Return a run without yaw rate, and the true one."""
    V, beta = 15 + 2 * np.sin(0.5 * T), 0.4 * np.sin(1.3 * T)
    return dj.Run("turning", T, V, beta, NONE, 0 * T, 0 * T, DT, extra), 0.8 * np.sin(2 * T)


def estimated(run: dj.Run) -> tuple[np.ndarray, tuple[str, ...]]:
    log = resolved_log(dj.load_vehicle("sedan"), dj.Log((run,)))
    return log.runs[0].r, log.notes


def test_the_rate_of_a_noisy_heading_has_no_bias():
    noise = 0.002 * np.random.default_rng(0).standard_normal(len(T))
    noise[100:110] = np.nan
    run, true = turning(psi=0.4 * (1 - np.cos(2 * T)) + noise)
    r, notes = estimated(run)
    there, known = np.isfinite(noise), np.isfinite(r)
    assert known[there].mean() > 0.99 and not known[102:108].any()
    assert np.std((r - true)[known]) < 1.5 * np.nanstd(np.gradient(noise, DT))
    silent, _ = estimated(turning(psi=0.4 * (1 - np.cos(2 * T)))[0])
    np.testing.assert_allclose(silent, true, atol=1e-4)
    assert any("rate of their heading" in note for note in notes)


def test_a_measured_yaw_rate_stays_and_a_run_with_nothing_is_refused():
    run, true = turning(psi=0.4 * (1 - np.cos(2 * T)))
    measured = dataclasses.replace(run, r=true)
    assert estimated(measured)[0] is measured.r and not estimated(measured)[1]
    with pytest.raises(dj.BadInput, match="Run 'turning' has neither a yaw rate nor a heading; map r or psi"):
        estimated(dataclasses.replace(run, extra={"psi": NONE}))


def test_errors_of_a_gyro_are_not_judged_by_a_heading_and_the_sentence_says_so():
    run, true = turning(psi=0.4 * (1 - np.cos(2 * T)))
    vehicle, effects = dj.load_vehicle("sedan"), dj.effects_by_name(("mass", "gyro_bias", "gyro_scale"))
    (estimate,) = resolved_log(vehicle, dj.Log((run,))).runs
    of_heading, measured = (
        initial_problem(vehicle, effects, (one,)) for one in (estimate, dataclasses.replace(run, r=true))
    )
    assert of_heading.active.tolist() == [True, False, False] and measured.active.all()
    assert not of_heading.data.yaw_rate_measured and measured.data.yaw_rate_measured
    assert select_effects(of_heading, ("mass", "gyro_scale")) == ((0,), {"gyro_scale": "r"})
    assert "has no yaw rate" in Unidentifiable(("r",), {}, {}, ()).sentence


def test_a_drive_without_a_heading_faces_the_wind_by_the_integral_of_its_yaw_rate():
    run, true = turning()
    drive = dj.Log((dataclasses.replace(run, r=true),))
    vehicle, effects = dj.load_vehicle("sedan"), dj.effects_by_name(("mass", "side_wind", "road_grade"))
    halves = resolved_log(vehicle, drive.split_runs(5)).runs
    assert len(halves) == 2
    problem = initial_problem(vehicle, effects, halves)
    assert problem.active.all() and problem.data.motion is None  # what was integrated is no measurement
    psi = np.concatenate([half.extra["turned"] for half in halves])
    np.testing.assert_allclose(psi, 0.4 * (1 - np.cos(2 * T)), atol=0.02)
    place = problem.data.padded.place.psi[problem.data.run == 1]
    assert place[0, 0] == pytest.approx(psi[len(halves[0].t)], abs=1e-9)
    with_heading = dataclasses.replace(drive.runs[0], extra={"psi": psi})
    assert "turned" not in resolved_log(vehicle, dj.Log((with_heading,))).runs[0].extra


def test_drives_without_a_heading_begin_in_one_direction_and_the_sentence_says_so():
    run, true = turning()
    first = dataclasses.replace(run, r=true)
    second = dataclasses.replace(first, name="second", t=first.t + 60)
    vehicle, effects = dj.load_vehicle("sedan"), dj.effects_by_name(("mass", "side_wind", "road_grade"))
    one, other = resolved_log(vehicle, dj.Log((first, second))).runs
    np.testing.assert_array_equal(one.extra["turned"], other.extra["turned"])
    assert initial_problem(vehicle, effects, (one, other)).active.all()
    assert "as if all drives began in one direction" in Unidentifiable(("psi",), {}, {}, ()).sentence
