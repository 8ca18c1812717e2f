"""Minimisation within bounds on functions whose minimum is known, against SciPy, and where it must fail."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import lsq_linear

from driftjax.core import RESULTS, bounded
from driftjax.core.bounded import minimise_within

LOW, HIGH = jnp.array([-2.0, -2.0]), jnp.array([0.5, 3.0])


def valley(x, bend):
    """Rosenbrock's function, with no value left of x_1 = -1.5."""
    return bend * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2 + 0 * jnp.log(x[0] + 1.5)


@jax.jit
def minimum(start, bend=100.0, low=LOW, high=HIGH):
    return minimise_within(valley, start, low, high, bend, tolerance=1e-9, max_steps=100)


def test_box_constrained_least_squares_are_scipys():
    rng = np.random.default_rng(0)
    A, b, low, high = rng.normal(size=(30, 8)), rng.normal(size=30), jnp.full(8, -0.1), jnp.full(8, 0.1)

    @jax.jit
    @jax.vmap
    def ours(b):
        cost = lambda x, b: 0.5 * jnp.sum((A @ x - b) ** 2)
        return minimise_within(cost, jnp.zeros(8), low, high, b, tolerance=1e-9, max_steps=100)

    ends = ours(jnp.stack([b, 3 * b, -b]))
    assert jnp.all(ends.result == RESULTS.successful)
    for x, target in zip(ends.x, (b, 3 * b, -b), strict=True):
        np.testing.assert_allclose(x, lsq_linear(A, target, (low, high), tol=1e-14).x, atol=1e-8)
        assert jnp.any((x == low) | (x == high))


def test_the_minimum_on_a_bound_is_found_from_a_start_outside():
    end = minimum(jnp.array([-1.2, 4.0]))
    np.testing.assert_allclose(end.x, [0.5, 0.25], atol=1e-7)
    assert end.result == RESULTS.successful and end.error <= 1e-9
    np.testing.assert_allclose(end.value, 0.25, rtol=1e-12)


def test_failures_are_reported():
    few = jax.jit(lambda x: minimise_within(valley, x, LOW, HIGH, 100.0, tolerance=1e-9, max_steps=3))
    assert few(jnp.array([-1.2, 1.0])).result == RESULTS.not_converged
    assert minimum(jnp.array([-1.9, 1.0])).result == RESULTS.non_finite
    assert minimum(jnp.array([0.0, 1.0]), low=HIGH, high=LOW).result == RESULTS.infeasible


def test_jaxopt_is_imported_in_one_module_and_only_when_used():
    package = Path(bounded.__file__).parents[1]
    users = [path.name for path in package.rglob("*.py") if "jaxopt import" in path.read_text(encoding="utf-8")]
    assert users == ["bounded.py"]
    check = "import sys, driftjax.gp, driftjax.diagnosis.noise; sys.exit('jaxopt' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", check], check=False).returncode == 0
