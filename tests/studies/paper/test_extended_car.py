"""The log from which the comparison's extended car is found: a double-track car that sustains drifts, measured with
noise."""

import dataclasses

import numpy as np
import pytest

from driftjax.manoeuvres.campaign import typical_conditions
from driftjax.manoeuvres.library import RICH
from driftjax.studies.paper.extended import RATE, SECONDS, simulated_runs
from driftjax.vehicle import load_plant, load_vehicle


@pytest.fixture(scope="module", params=["sedan", "rc"])
def log(request):
    vehicle = load_vehicle(request.param).with_combined_slip(None)
    return vehicle, simulated_runs(load_plant(request.param).build(), vehicle, np.random.default_rng(5))


def test_drifts_are_held_and_the_rest_is_driven_with_grip(log):
    _, runs = log
    assert [run.name.rsplit("-", 1)[0] for run in runs] == list(RICH)
    for run in runs:
        assert len(run.t) == SECONDS * RATE and run.t[0] == pytest.approx(0)
        turned = abs(np.mean(run.beta))
        assert turned > 0.25 if run.name.startswith("drift") else turned < 0.1
        if run.name.startswith("drift"):
            assert np.sign(np.mean(run.beta)) == -np.sign(np.mean(run.r))


def test_commands_keep_to_the_limits_and_measurements_have_the_noise_asked_for(log):
    vehicle, runs = log
    lower, upper, rate = vehicle.command_limits()
    sigma = np.asarray(typical_conditions(vehicle).sigma)
    for run in runs:
        command = np.stack([run.delta, run.Fxr], axis=1)
        assert np.all(command >= np.asarray(lower) - 1e-9) and np.all(command <= np.asarray(upper) + 1e-9)
        assert np.all(np.abs(np.diff(command, axis=0)) <= np.asarray(rate) / RATE * (1 + 1e-9))
        second = np.diff([run.V, run.beta], n=2, axis=1)  # of white noise: sqrt(6) times its deviation
        assert np.all(np.std(second, axis=1) > 0.8 * np.sqrt(6) * sigma[:2])
        assert np.all(np.std(second, axis=1) < 1.3 * np.sqrt(6) * sigma[:2])


def test_a_car_that_cannot_be_held_is_reported():
    vehicle = load_vehicle("sedan").with_combined_slip(None)
    ice = dataclasses.replace(load_plant("sedan"), muf=0.15, mur=0.15)
    with pytest.raises(RuntimeError, match="it spun in 6 draws"):
        simulated_runs(ice.build(), vehicle, np.random.default_rng(5))
