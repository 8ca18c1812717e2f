"""Outliers: single samples that jump are found, noise, motion, steps, held and quantised values are not."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, ORDER, build_problem, hidden, recorded, sedan

from driftjax.diagnosis.beam import best_parameters, quadratic_cost
from driftjax.diagnosis.fit import evaluate_fit, linearise
from driftjax.diagnosis.outliers import outliers, without_outliers
from driftjax.logs import Run


def smooth(num: int = 4000) -> np.ndarray:
    t = 0.01 * np.arange(num)
    return np.sin(1.5 * t) + 0.3 * np.sin(9 * t)


def test_outliers_are_found_and_nothing_else():
    rng, y = np.random.default_rng(0), smooth()
    y += 0.01 * rng.normal(size=len(y))
    assert not outliers(y).any()
    at = rng.choice(np.arange(10, len(y), 4), 40, replace=False)
    y[at] += 0.01 * rng.uniform(10, 30, 40) * rng.choice([-1, 1], 40)
    assert set(np.flatnonzero(outliers(y))) >= set(at[1:]) - {at.min()} and outliers(y).sum() <= 42
    y[100:103] = np.nan
    assert not outliers(y)[100:103].any()


@pytest.mark.parametrize(
    "y",
    [np.repeat(smooth(400), 3), np.round(smooth() + 0.002 * np.random.default_rng(1).normal(size=4000), 2),
     np.where(np.arange(400) < 200, 0.0, 1.0), np.zeros(100), np.full(100, np.nan), np.array([0.0, 5.0, 0.0]),
     smooth() + np.where(np.abs(np.arange(4000) - 2000) < 4, 0.5, 0.0)],
    ids=["held", "quantised", "step", "constant", "missing", "short", "bump"],
)  # fmt: skip
def test_what_a_sensor_or_a_car_does_is_no_outlier(y):
    assert not outliers(y).any()


def test_a_log_that_hardly_resolves_the_motion_loses_nothing():
    y = smooth(200) + 0.01 * np.random.default_rng(2).normal(size=200)
    y[50] += 1.0
    run = Run("one", 0.01 * np.arange(200), y + 5, y, y, y, y, 0.01)
    assert np.flatnonzero(np.isnan(without_outliers(run, 2.8).r)).tolist() == [50]
    slow = without_outliers(replace(run, dt=0.05, t=5 * run.t), 0.3)
    assert np.isfinite(slow.r).all()


def test_a_yaw_rate_that_no_car_reaches_is_missing_at_any_rate():
    """A heading that jumps by 2 pi within a sample of 1/30 s turns at 190 rad/s."""
    t = np.arange(100) / 30
    r = 6.0 * np.sin(8 * t)
    r[[20, 21, 60]] = 2 * np.pi * 30 * np.array([1, 1, -1])
    run = Run("one", t, 3 + 0 * t, 0 * t, r, 0 * t, 0 * t, 1 / 30)
    assert np.flatnonzero(np.isnan(without_outliers(run, 0.3).r)).tolist() == [20, 21, 60]
    standing = replace(run, V=0.02 + 0 * t, r=0.1 * np.sin(8 * t))
    assert np.isfinite(without_outliers(standing, 0.3).r).all()


def estimate(runs: tuple[Run, ...]) -> tuple[np.ndarray, np.ndarray]:
    """All parameters of the small catalogue, fitted to first order, and their standard deviations."""
    problem = build_problem(sedan(), EFFECTS, runs)
    start = evaluate_fit(problem, problem.start)
    model = quadratic_cost(problem, start, linearise(problem, start))
    return best_parameters(model, tuple(range(len(ORDER)))), np.sqrt(np.diag(np.linalg.inv(model.H)))


def test_outliers_of_a_sensor_do_not_move_estimates():
    clean = recorded(hidden(stiffness_front=-0.8), 31, 1)
    rng = np.random.default_rng(3)
    dirty = []
    for run in clean:
        rows = {}
        for name, sigma in zip(("V", "beta", "r"), (0.05, 0.01, 0.01), strict=True):
            off = sigma * rng.uniform(10, 30, len(run.t)) * rng.choice([-1.0, 1.0], len(run.t))
            rows[name] = getattr(run, name) + np.where(rng.random(len(run.t)) < 0.01, off, 0.0)
        dirty.append(replace(run, **rows))
    (theta, deviation), (moved, _) = estimate(clean), estimate(tuple(dirty))
    assert np.abs((moved - theta) / deviation).max() < 1.0
