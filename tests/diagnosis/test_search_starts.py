"""The search for sets on small costs that are not quadratic: local optima and bounds."""

import numpy as np
from diagnosis.toy import BLOCKS, LENGTH, toy_problem

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


def test_a_search_leaves_a_local_optimum_at_a_bound_for_a_set_that_the_nominal_car_promises(monkeypatch):
    problem, nominal = toy_problem(monkeypatch, imitated, np.full(4, -3.0), np.array([0.8, 3.0, 3.0, 3.0]))
    found = search(problem, nominal)
    assert found.selected == (1, 2, 3)
    np.testing.assert_allclose(found.fit.theta, [0, 1, 1, 1], atol=0.1)
