"""A sideslip that no sensor measures: where a run begins, and gains that hold a car that drifts."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, hidden, nominal_car, recorded

from driftjax.diagnosis.fit import Problem, initial_problem
from driftjax.diagnosis.runs import extended_gains, gains_along, run_observer, step_derivatives
from driftjax.logs import Run


@functools.cache
def drifts(car: str) -> tuple[Run, ...]:
    """Drifts of the right car."""
    return tuple(run for run in recorded(hidden(), 3, 4, car=car) if run.name.startswith("drift"))


@functools.cache
def inferred(car: str) -> Problem:
    """The same without a sideslip, and without the pose, which would tell it."""
    runs = [replace(run, beta=np.full(len(run.t), np.nan), extra={}) for run in drifts(car)]
    return initial_problem(nominal_car(car), EFFECTS, tuple(runs))


@pytest.mark.parametrize("car", ["sedan", "rc"])
def test_a_drift_is_followed_from_its_start_without_a_sensor_of_the_sideslip(car: str):
    problem, num = inferred(car), len(drifts(car)[0].t)
    true = np.array([run.beta for run in drifts(car)])  # with the noise of a sensor of 0.5 deg
    assert len(true) > 2 and np.abs(true).mean() > 0.3
    rolling = np.array([np.arctan(nominal_car(car).b * run.r[:3].mean() / run.V[:3].mean()) for run in drifts(car)])
    start = np.asarray(problem.data.padded.start)[:, 1]
    assert np.abs(start - true[:, 0]).max() < 0.35 < np.abs(rolling - true[:, 0]).min()
    path = run_observer(problem.model, problem.data, problem.start, problem.gains)
    settled = slice(problem.data.skip, num)
    error = np.asarray(path.z)[:, settled, 1] - true[:, settled]
    assert np.sqrt(np.mean(error**2)) < 0.02


def test_gains_are_those_along_the_path_that_they_lead_to():
    problem = inferred("sedan")
    model, data, noise = problem.model, problem.data, problem.noise.as_vector()
    gains = extended_gains(model, data, problem.start, noise)
    path = run_observer(model, data, problem.start, gains)
    along = step_derivatives(model, data, problem.start, path, problem.active)
    other = gains_along(data, along, path.valid, noise)
    there = np.asarray(path.valid).any(axis=2)
    for name in ("L", "whitening", "P"):
        one, two = (np.asarray(getattr(each, name))[there] for each in (gains, other))
        np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-9 * np.abs(two).max())
    np.testing.assert_allclose(gains.log_det, other.log_det, rtol=1e-8)
