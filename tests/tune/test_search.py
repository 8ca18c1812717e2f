"""The searches on a known function: steps only downhill, budgets kept, boxes kept."""

import numpy as np
import pytest

from driftjax.tune.search import descend, random_search

BOX = np.array([2.0, 2.0])
VALLEY = np.array([0.7, -5.0])  # of which the second lies outside the box


def errors(p):
    return np.array([3 * (p[0] - VALLEY[0]), 0.5 * (p[1] - VALLEY[1]), 0.3 * p[0] * p[1]])


def evaluate(points):
    return np.array([np.sum(errors(p) ** 2) for p in points])


def slope(p):
    J = np.array([[3.0, 0.0], [0.0, 0.5], [0.3 * p[1], 0.3 * p[0]]])
    return 2 * J.T @ errors(p), 2 * J.T @ J


def test_gradients_go_to_the_lowest_point_of_the_box_within_the_budget():
    result = descend(evaluate, slope, BOX, 60)
    assert result.cost <= 60 and np.all(np.abs(result.p) <= BOX)
    grid = np.stack(np.meshgrid(*[np.linspace(-2, 2, 201)] * 2), axis=-1).reshape(-1, 2)
    assert result.loss <= evaluate(grid).min() * 1.001
    costs, losses = np.array(result.history).T
    assert np.all(np.diff(losses) <= 0) and np.all(np.diff(costs) > 0)


def test_a_gradient_that_misleads_never_makes_it_worse():
    result = descend(evaluate, lambda p: (-slope(p)[0], slope(p)[1]), BOX, 60)
    assert result.loss <= evaluate(np.zeros((1, 2)))[0]
    assert result.cost < 60  # gives up


@pytest.mark.parametrize("budget", [2, 7, 30])
def test_random_search_spends_its_budget_in_the_box_and_keeps_the_best(budget):
    seen = []

    def watched(points):
        seen.append(points)
        return evaluate(points)

    result = random_search(watched, BOX, budget, seed=1)
    assert result.cost == budget == sum(map(len, seen)) and np.all(np.abs(seen[0]) <= BOX)
    assert result.loss == evaluate(seen[0]).min() and len(result.history) == budget
