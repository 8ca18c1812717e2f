"""The search for sets on small costs that are not quadratic: local optima, bounds, what predicts."""

import numpy as np
import pytest
from diagnosis.toy import BLOCKS, LENGTH, toy_problem

from driftjax.diagnosis import select
from driftjax.diagnosis.select import search

SHAPE = (1, BLOCKS * LENGTH, 3)


def imitated(theta: np.ndarray) -> np.ndarray:
    """Residuals of b, c, d at 1 each, which `a` imitates; where `a` acts, b and c have another signature."""
    rng = np.random.default_rng(0)
    b, c, d, other_b, other_c, more, noise = rng.normal(size=(7, *SHAPE))
    a, turn = 0.9 * (b + c + d) + 0.1 * more, 1.5 * theta[0]
    turned = lambda one, other: np.cos(turn) * one + np.sin(turn) * other
    mine = theta[0] * a + theta[1] * turned(b, other_b) + theta[2] * turned(c, other_c) + theta[3] * d
    return b + c + d + 0.5 * noise - mine


def test_a_search_leaves_a_local_optimum_at_a_bound_for_a_set_found_about_the_nominal_car(monkeypatch):
    problem, nominal = toy_problem(monkeypatch, imitated, np.full(4, -3.0), np.array([0.8, 3.0, 3.0, 3.0]))
    selection = search(problem, nominal)
    assert selection.selected == (1, 2, 3)
    np.testing.assert_allclose(selection.fit.theta, [0, 1, 1, 1], atol=0.1)


def elsewhere(theta: np.ndarray) -> np.ndarray:
    """Residuals of a, b, c, d at 1 each in all six runs, and of e in the first run alone."""
    rng = np.random.default_rng(1)
    J, noise = rng.normal(size=(5, 6, *SHAPE[1:])), rng.normal(size=(6, *SHAPE[1:]))
    truth = J[:4].sum(axis=0) + np.where(np.arange(6)[:, None, None] == 0, J[4], 0.0)
    return truth + 0.5 * noise - np.tensordot(theta, J, axes=1)


def test_later_effects_are_named_only_where_they_predict_what_they_were_not_fitted_to(monkeypatch):
    problem, nominal = toy_problem(monkeypatch, elsewhere, np.full(5, -3.0), np.full(5, 3.0), runs=6)
    selection = search(problem, nominal)
    assert selection.selected == (0, 1, 2, 3)
    assert selection.scores.p_value < 0.05  # the test alone would go on


def bound_by(share: float):
    """Residuals of a at 1, in part imitated by b, which may not be as large as the rest would have it."""
    rng = np.random.default_rng(2)
    a, more, noise = rng.normal(size=(3, 6, *SHAPE[1:]))
    b = 0.5 * a + 0.5 * more
    return lambda theta: a + share * more + 0.5 * noise - theta[0] * a - theta[1] * b


@pytest.mark.parametrize(("share", "named"), [(0.06, (0,)), (0.6, (0, 1))], ids=["little", "much"])
def test_an_effect_at_its_bound_stays_only_where_it_predicts_better(monkeypatch, share, named):
    upper = np.array([3.0, 0.05 if share < 0.1 else 0.5])
    problem, nominal = toy_problem(monkeypatch, bound_by(share), np.zeros(2), upper, runs=6)
    monkeypatch.setattr(select, "MIN_SIZE", 0.01)
    selection = search(problem, nominal)
    assert selection.selected == named
