"""Two logs fitted together on small costs that are not quadratic: bounds, SciPy's minimum, which difference it is."""

import numpy as np
import pytest
from diagnosis.toy import BLOCKS, LENGTH, toy_problem
from scipy.optimize import minimize

from driftjax.diagnosis import contrast, refine
from driftjax.diagnosis.contrast import (
    fit_pair,
    fit_together,
    prefer_refitted,
    probabilities,
    refit_together,
    sum_of_costs,
)

T, LOWER, UPPER = BLOCKS * LENGTH, np.array([-3.0, 0.0, 0.0, -3.0]), np.full(4, 3.0)
LATE, SLOPE = (2,), (3,)  # effects c and d


def steered(late: float, seed: int):
    """Residuals (1, T, 3) of a log late by c: a is a gain, b grows with time, d is what a small delay looks like."""
    noise = 0.1 * np.random.default_rng(seed).normal(size=(1, T, 3))
    t, phase = 0.1 * np.arange(T)[:, None], np.array([0.0, 1.0, 2.0])
    wave = lambda c: np.sin(t - c + phase) + 0.5 * np.sin(2.3 * (t - c) + phase)
    slope, ramp = np.cos(t + phase) + 1.15 * np.cos(2.3 * t + phase), np.linspace(0.0, 1.0, T)[:, None]
    model = lambda theta: (1 + theta[0]) * wave(theta[2]) + theta[1] * ramp - theta[3] * slope
    return lambda theta: model(np.array([0.5, 0.7, late, 0.0])) + noise - model(theta)


@pytest.fixture
def pair(monkeypatch):
    """Both logs, the second one late by 0.6, with gain and growth fitted to each."""
    each = []
    for late, seed in ((0.0, 0), (0.6, 1)):
        problem, _ = toy_problem(monkeypatch, steered(late, seed), LOWER, UPPER)
        each.append((problem, contrast.evaluate_fit, contrast.linearise))
    own = lambda problem: next(row for row in each if row[0] is problem)
    for module in (contrast, refine):
        monkeypatch.setattr(module, "linearise", lambda problem, fit: own(problem)[2](problem, fit))
    monkeypatch.setattr(contrast, "evaluate_fit", lambda problem, theta: own(problem)[1](problem, theta))
    many = lambda problem, thetas: [own(problem)[1](problem, theta) for theta in thetas]
    monkeypatch.setattr(refine, "evaluate_fits", many)
    problems = each[0][0], each[1][0]
    return fit_pair(problems, (0, 1, 2, 3), (problems[0].start, problems[1].start))


def test_both_logs_fitted_together_cost_as_little_as_scipy_finds(pair):
    about, fits = refit_together(pair, LATE)
    shared = fits[0].theta[[0, 1, 3]]
    np.testing.assert_array_equal(shared, fits[1].theta[[0, 1, 3]])
    apart = lambda x: (np.array([x[0], x[1], x[2], x[4]]), np.array([x[0], x[1], x[3], x[4]]))
    cost = lambda x: sum(one.cost for one in map(contrast.evaluate_fit, pair.problems, apart(x)))
    bounds = [(-3, 3), (0, 3), (0, 3), (0, 3), (-3, 3)]
    best = minimize(cost, [0.4, 0.5, 0.1, 0.5, 0.1], bounds=bounds, method="L-BFGS-B")
    assert sum_of_costs(fits) == pytest.approx(best.fun, abs=0.02)
    late = [fit.theta[2] for fit in fits]
    assert late[0] < 0.02 and late[1] - late[0] == pytest.approx(0.6, abs=0.03)
    np.testing.assert_array_equal(about.second.theta, fits[1].theta)


def test_nothing_named_leaves_both_logs_at_the_nominal_car(pair):
    nothing = pair._replace(effects=())
    fits = refit_together(nothing, ())[1]
    for problem, fit in zip(pair.problems, fits, strict=True):
        np.testing.assert_array_equal(fit.theta, problem.start)
    assert len(fit_together(nothing, ())[1].difference) == 0


def test_a_rival_that_costs_less_in_both_logs_together_is_the_difference(pair, monkeypatch):
    linear = probabilities(pair.contrast, SLOPE, 3)
    monkeypatch.setattr(contrast, "_credible", lambda at, selected, member: [*{*LATE, *SLOPE} - {member}])
    assert sum_of_costs(refit_together(pair, SLOPE)[1]) > 2 * sum_of_costs(refit_together(pair, LATE)[1])
    for first in (SLOPE, LATE):
        after, selected = prefer_refitted(pair, first)
        assert selected == LATE
        share = probabilities(after.contrast, selected, 2, after.refitted)
        assert share[2] > 0.99 and share.sum() == pytest.approx(1.0)
    assert not np.allclose(linear, share)
    assert prefer_refitted(pair, ())[1] == ()
