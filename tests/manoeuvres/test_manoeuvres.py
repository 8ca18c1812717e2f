"""Each manoeuvre of the library does what its name says, on both cars, with typical noise."""

import dataclasses

import numpy as np
import pytest

from driftjax.manoeuvres.campaign import Campaign, record_runs
from driftjax.manoeuvres.library import MANOEUVRES
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import EFFECTS

NEUTRAL = np.zeros(sum(len(effect.parameters) for effect in EFFECTS.values()))
SHORT = Campaign(tuple(MANOEUVRES), duration=2.0)


@pytest.fixture(scope="module", params=["sedan", "rc"])
def driven(request):
    """One run of every manoeuvre by name, and its true states."""
    vehicle = dataclasses.replace(load_vehicle(request.param), combined_slip=1.0)
    runs, truth = record_runs(vehicle, NEUTRAL, SHORT)
    assert truth.left_out == () and truth.effects == {}
    return {run.name.split("-")[0]: (run, truth.states[run.name]) for run in runs}


def test_all_stay_finite_within_what_a_log_may_hold(driven):
    assert set(driven) == set(MANOEUVRES)
    for run, x in driven.values():
        assert np.isfinite(x).all() and x[:, 0].min() > 0.5 and len(run.t) == 200
        assert all(np.isfinite(getattr(run, name)).all() for name in ("V", "beta", "r", "delta", "Fxr"))


@pytest.mark.parametrize("name", ["drift", "steady_drift"])
def test_a_drift_slides_out_of_its_turn(name, driven):
    run, x = driven[name]
    assert np.mean(np.abs(x[:, 1]) > 0.3) > 0.8
    assert (x[:, 1] * x[:, 2] < 0).all()
    assert np.mean(run.delta * x[:, 2] < 0) > 0.8  # counter-steer
    assert run.Fxr.mean() > 0


def test_the_excited_drift_wiggles_more_than_the_steady_one(driven):
    wiggle = {name: np.std(driven[name][0].delta) for name in ("drift", "steady_drift")}
    assert wiggle["drift"] > 1.3 * wiggle["steady_drift"]


@pytest.mark.parametrize("name", ["grip_sine", "slalom", "step_steer", "throttle_steps", "coast_down"])
def test_with_grip_sideslip_stays_small(name, driven):
    assert np.abs(driven[name][1][:, 1]).max() < 0.15


def test_coasting_is_without_drive_and_straight(driven):
    run, x = driven["coast_down"]
    assert (run.Fxr == 0).all() and (run.delta == 0).all() and np.abs(x[:, 2]).max() < 0.3


def test_slalom_steers_to_and_fro_ever_faster(driven):
    steer = driven["slalom"][0].delta
    turns = np.flatnonzero(np.diff(np.sign(steer[steer != 0])))
    times = np.diff(turns)
    assert len(turns) > 2 and (np.diff(times) <= 1).all()  # to a sample
    assert times[-1] < 0.9 * times[0]


def test_steps_are_steps(driven):
    throttle = driven["throttle_steps"][0].Fxr
    assert throttle.max() > 0 > throttle.min()
    steer = driven["step_steer"][0].delta
    assert np.mean(np.abs(np.diff(steer)) < 1e-9) > 0.4 and steer.max() > 0 > steer.min()
