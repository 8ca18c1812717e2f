"""What a calibration follows: single steps of a right car, predictions where single steps mislead."""

import functools

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, ORDER, hidden, recorded, sedan
from diagnosis.test_prediction_fit import HIDDEN, smooth_runs

from driftjax.diagnosis.calibrate import calibrate
from driftjax.diagnosis.calibration_fit import CalibrationFit, fit_by_predictions, fit_by_steps, fit_by_the_better
from driftjax.diagnosis.fit import Problem, initial_problem, with_noise
from driftjax.diagnosis.gain import DECISIVE, open_loop_errors, ratios
from driftjax.diagnosis.memory import memory_of
from driftjax.diagnosis.multistart import with_nominal_noise
from driftjax.logs import Log

TUNED = ("friction_rear", "stiffness_front")  # by a person who does not know of the steering lag, nor of the filter


def numbers(names) -> tuple[int, ...]:
    return tuple(ORDER.index(name) for name in names)


@functools.cache
def loose_problem() -> Problem:
    return with_nominal_noise(initial_problem(sedan(), EFFECTS, smooth_runs(1) + smooth_runs(3)))


def error_on_other_runs(car: CalibrationFit) -> float:
    """Return the error about 1 s ahead over that of the nominal car, on runs that no fit has seen."""
    other = initial_problem(sedan(), EFFECTS, smooth_runs(5))
    other = with_noise(other, other.start, car.problem.noise)
    nominal, fitted = (open_loop_errors(other, theta) for theta in (other.start, car.fit.theta))
    return float(ratios(nominal, fitted)[DECISIVE, 0])


@pytest.mark.parametrize("staged", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_where_single_steps_mislead_the_car_is_fitted_to_predictions(staged):
    """They shift onto grip and stiffness what the car lacks: a steering lag, and the filter of the sideslip."""
    stages, selected = [], numbers(TUNED)
    steps = fit_by_steps(loose_problem(), selected, staged)
    car = fit_by_the_better(loose_problem(), selected, staged, seed=0, report=stages.append)
    assert car.by_predictions and "long memory" in stages
    assert memory_of(car.searched) > 10 * memory_of(car.problem)
    assert error_on_other_runs(car) < 0.85 * error_on_other_runs(steps)
    off = [abs(one.fit.theta[ORDER.index("friction_rear")] - hidden(**HIDDEN)[0]) for one in (car, steps)]
    assert off[0] < 1.0 < off[1]


def test_a_right_car_is_fitted_to_single_steps():
    loose = with_nominal_noise(initial_problem(sedan(), EFFECTS, recorded(hidden(**HIDDEN), 1, 2)))
    car = fit_by_the_better(loose, numbers(HIDDEN), False, seed=0)
    assert not car.by_predictions and car.searched is car.problem
    other = fit_by_predictions(car, numbers(HIDDEN), False)
    assert other is not None
    np.testing.assert_allclose(other.fit.theta, car.fit.theta, atol=0.25)  # both are right, single steps more precise


def test_the_calibration_states_what_it_follows():
    found = calibrate(sedan(), Log(smooth_runs(1)), TUNED, catalogue=EFFECTS)
    assert found.gain is not None and found.gain.by_predictions and found.car.by_predictions
    assert found.content()["fitted_by"] == "predictions"
    assert "an observer with a memory of 1.1 s gives" in str(found)
    values = {one.effect: one.value for one in found.vehicle.effects}
    assert values == {row.parameter.split(".")[0]: row.value for row in found.parameters}
