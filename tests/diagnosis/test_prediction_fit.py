"""Sizes fitted to predictions: against SciPy, of a right car, of a wrong one that single steps mislead, of sensors."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from diagnosis.recorded import DT, EFFECTS, ORDER, build_problem, hidden, problem_of, recorded, sedan
from scipy.optimize import minimize
from scipy.signal import lfilter

from driftjax.diagnosis.diagnose import diagnose
from driftjax.diagnosis.evidence import spread_with
from driftjax.diagnosis.fit import Problem, evaluate_fit, initial_problem, with_noise
from driftjax.diagnosis.gain import at_horizons, open_loop_errors, predict, ratios
from driftjax.diagnosis.held_out import DiagnoseConfig, refit_extended
from driftjax.diagnosis.prediction_fit import HUBER, fit_to_predictions
from driftjax.diagnosis.refine import refit_to_convergence
from driftjax.diagnosis.score import scores
from driftjax.diagnosis.select import Selection
from driftjax.logs import Log, Run

HIDDEN = {"friction_rear": -1.0, "steer_lag": 1.0}
OTHERS = tuple(name for name in ORDER if name not in HIDDEN)
FILTER = 0.2  # time constant of a sideslip sensor that the catalogue does not know [s]


def columns_of(*names: str) -> np.ndarray:
    return np.sort([ORDER.index(name) for name in names])


def filtered(run: Run) -> Run:
    """The run as a sensor reads it whose sideslip is a smooth average of the past."""
    share = np.exp(-DT / FILTER)
    return replace(run, beta=lfilter([1 - share], [1, -share], run.beta, zi=[share * run.beta[0]])[0])


@functools.cache
def smooth_runs(seed: int) -> tuple[Run, ...]:
    return tuple(map(filtered, recorded(hidden(**HIDDEN), seed, seed + 1)))


def fitted(problem: Problem, *names: str) -> Selection:
    """The effects `names`, fitted by the likelihood."""
    columns, start = columns_of(*names), evaluate_fit(problem, problem.start)
    fit, at = refit_to_convergence(problem, start, columns)
    chosen = tuple(columns.tolist())
    tested = scores(problem, at, fit.theta, chosen, 0)
    return Selection(chosen, fit, at, tested, problem, start, tested)


def test_the_minimum_is_the_one_that_scipy_finds():
    problem, columns = problem_of(1, 2, friction_rear=-1.0, drive_gain=1.0), columns_of("friction_rear", "drive_gain")
    found = fit_to_predictions(problem, (problem.start,), columns)
    first = at_horizons(problem, predict(problem, problem.start).error)
    rms = np.sqrt(np.nanmean(first.squares[:, 1:3] ** 2, axis=0))

    def objective(x: np.ndarray) -> float:
        theta = problem.start.copy()
        theta[columns] = x
        size = np.abs(at_horizons(problem, predict(problem, theta).error).squares[:, 1:3] / rms)
        loss = np.nansum(np.where(size < HUBER, size**2, HUBER * (2 * size - HUBER)))
        return len(np.unique(first.block)) * np.log(loss) + x @ problem.prior[np.ix_(columns, columns)] @ x

    best = minimize(objective, found.theta[columns], method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-5})
    assert objective(found.theta[columns]) < best.fun + 0.02  # a seventh of a standard deviation
    assert np.all(np.abs(best.x - found.theta[columns]) < 0.2 * found.spread.half_width)
    assert 0.95 < refit_extended(problem, fitted(problem, "friction_rear", "drive_gain")).lowered <= 1.0
    truth = hidden(friction_rear=-1.0, drive_gain=1.0)[columns]
    assert np.all(np.abs(found.theta[columns] - truth) < 1.5 * found.spread.half_width)
    assert not found.theta[np.setdiff1d(np.arange(len(ORDER)), columns)].any()


def test_a_sensor_that_smooths_misleads_single_steps_but_not_predictions():
    problem = build_problem(sedan(), EFFECTS, smooth_runs(1))
    selection = fitted(problem, *HIDDEN)
    refit = refit_extended(problem, selection)
    other = with_noise(initial_problem(sedan(), EFFECTS, smooth_runs(3)), problem.start, problem.noise)
    assert refit.lowered < 0.9, "on the runs that both are fitted to"
    nominal = open_loop_errors(other, other.start)
    likely, ahead = (ratios(nominal, open_loop_errors(other, one.theta))[2, 0] for one in (selection.fit, refit))
    assert likely > 1.0 > 0.85 > ahead, "about 1 s ahead, on runs that neither has seen"


def test_the_sizes_of_the_verdict_are_those_of_the_car_and_of_its_gain(monkeypatch):
    """Where no observer of longer memory names effects that predict better."""
    monkeypatch.setattr("driftjax.diagnosis.predictive_naming.with_long_memory", lambda problem: None)
    result = diagnose(sedan(), Log(smooth_runs(1)), DiagnoseConfig(gp=False, without=OTHERS), effects=EFFECTS)
    content, gain = result.content(), result.gain
    assert content["sizes_fitted_to"] == "predictions" and "predict best up to 1.1 s ahead" in result.sentence
    assert gain is not None and gain.refitted and set(gain.named) == set(HIDDEN) == set(gain.without)
    assert all(np.isfinite(one).all() for one in gain.without.values()) and content["answer"] == "extended"
    values = {one.effect: (one.value, one.ci95_half) for one in result.extended.effects}
    for cause in result.causes:
        (one,) = cause.parameters.values()
        value, half_width = values[cause.effect]
        assert (
            half_width is not None
            and one["value"] == value
            and one["ci95"] == pytest.approx([value - half_width, value + half_width])
        )


def test_sensors_keep_what_kinematics_tell():
    problem = build_problem(sedan(), EFFECTS, tuple(map(filtered, recorded(hidden(gyro_bias=1.0, **HIDDEN), 1, 2))))
    selection = fitted(problem, "gyro_bias", *HIDDEN)
    refit, bias = refit_extended(problem, selection), ORDER.index("gyro_bias")
    assert refit.theta[bias] == selection.fit.theta[bias] and bias not in refit.columns
    assert np.abs((refit.theta - selection.fit.theta)[refit.columns]).min() > 0.02
    both, own = spread_with(problem, selection, refit), spread_with(problem, selection, None)
    columns = columns_of("gyro_bias", *HIDDEN)
    at, car = np.flatnonzero(columns == bias), np.searchsorted(columns, refit.columns)
    assert both.half_width[at] == own.half_width[at] and not both.covariance[at, car].any()
    np.testing.assert_array_equal(both.half_width[car], refit.spread.half_width)
    less = refit.without(problem, np.array([bias]))
    assert less[bias] == 0 and np.array_equal(np.delete(less, bias), np.delete(refit.theta, bias))
