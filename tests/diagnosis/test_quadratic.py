"""The minimum of a quadratic function within bounds."""

import numpy as np
import pytest

from driftjax.diagnosis.quadratic import minimise_quadratic


def problem(seed: int, n: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the gradient, a badly conditioned curvature, and bounds about zero of which one pair is equal."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(n, n)))[0]
    H = axes @ np.diag(10.0 ** rng.uniform(-2, 3, n)) @ axes.T
    lower, upper = -rng.uniform(0.0, 1.0, n), rng.uniform(0.0, 1.0, n)
    lower[0] = upper[0]
    return 10 * rng.normal(size=n), H, lower, upper


@pytest.mark.parametrize("seed", range(40))
def test_nothing_pulls_away_from_the_minimum(seed: int):
    g, H, lower, upper = problem(seed)
    psi = minimise_quadratic(g, H, lower, upper)
    assert ((psi >= lower) & (psi <= upper)).all()
    pull = g - H @ psi  # the conditions of Karush, Kuhn and Tucker
    inside = (psi > lower) & (psi < upper)
    assert np.abs(pull[inside]).max(initial=0) < 1e-8 * np.abs(g).max()
    pull[lower == upper] = 0.0  # a fixed variable
    assert (pull[psi <= lower] <= 1e-8).all() and (pull[psi >= upper] >= -1e-8).all()


def test_a_variable_put_on_its_bound_too_early_leaves_it_again():
    # without bounds both lie above 1; with the first at 1, the second is best inside
    H = np.array([[1.0, 0.99], [0.99, 1.0]])
    g = H @ np.array([30.0, -28.0])
    psi = minimise_quadratic(g, H, np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    assert psi == pytest.approx([1.0, g[1] - 0.99], abs=1e-9)
