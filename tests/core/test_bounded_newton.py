"""The bounded minimisation on functions whose minimum is known, and where it must fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import RESULTS
from driftjax.core.bounded_newton import minimise_batch

WIDE = jnp.array([-5.0, -5.0]), jnp.array([5.0, 5.0])


def valley(x):
    """Rosenbrock's function by its residuals: value, gradient, and the curvature of Gauss and Newton."""
    r = jnp.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
    J = jnp.array([[-20 * x[0], 10.0], [-1.0, 0.0]])
    return 0.5 * r @ r, J.T @ r, J.T @ J


def waves(x):
    """Many minima, and a curvature that is that of none of them."""
    value = lambda x: jnp.sum(jnp.sin(3 * x) + 0.1 * x**2)
    return value(x), jax.grad(value)(x), 0.2 * jnp.eye(x.size)


def solved(evaluate, guess, bounds=WIDE, **options):
    return jax.jit(lambda guess: minimise_batch(evaluate, guess, *bounds, **options))(jnp.asarray(guess))


def test_a_curved_valley_is_followed_to_its_end():
    end = solved(valley, [-1.2, 1.0], max_iterations=100, tolerance=1e-8)
    np.testing.assert_allclose(end.x, [1.0, 1.0], atol=1e-6)
    assert end.result == RESULTS.successful and end.error <= 1e-8 and end.num_steps < 60


def test_the_minimum_on_a_bound_is_found_and_no_point_is_evaluated_outside():
    seen = []

    def watched(x):
        jax.debug.callback(lambda x: seen.append(np.asarray(x)), x)
        return valley(x)

    bounds = jnp.array([-2.0, -2.0]), jnp.array([0.5, 3.0])
    end = solved(watched, [-1.2, 4.0], bounds, max_iterations=100, tolerance=1e-8)
    jax.effects_barrier()
    np.testing.assert_allclose(end.x, [0.5, 0.25], atol=1e-7)
    assert end.result == RESULTS.successful and float(end.x[0]) == 0.5
    assert len(seen) == end.num_steps + 1
    assert all(np.all((bounds[0] <= x) & (x <= bounds[1])) for x in seen)


@pytest.mark.parametrize("steps", [1, 3, 40])
def test_no_end_is_above_its_start(steps):
    starts = jnp.asarray(np.random.default_rng(0).uniform(-4, 4, size=(30, 2)))
    run = lambda steps: jax.jit(jax.vmap(lambda x: minimise_batch(waves, x, *WIDE, max_iterations=steps)))(starts)
    ends, before = run(steps), run(0)
    np.testing.assert_array_equal(before.x, starts)
    assert jnp.all(ends.value <= before.value + 1e-14) and jnp.mean(ends.value < before.value - 1e-3) > 0.3
    np.testing.assert_allclose(ends.value, jax.vmap(lambda x: waves(x)[0])(ends.x), rtol=1e-12)
    if steps == 40:
        assert jnp.all(ends.result == RESULTS.successful)
    else:
        assert jnp.all((ends.num_steps <= steps) | (ends.result == RESULTS.successful))


def test_too_few_iterations_are_reported():
    end = solved(valley, [-1.2, 1.0], max_iterations=3)
    assert end.result == RESULTS.not_converged and end.num_steps == 3 and end.error > 1e-3


def test_a_start_without_a_value_is_reported_and_a_trial_without_one_is_not_taken():
    def root(x):  # NaN left of 0: full steps from 4 go there
        value = lambda x: jnp.sum(-jnp.log(x) + 8 * x)
        return value(x), jax.grad(value)(x), 1e-3 * jnp.eye(x.size)

    broken = solved(root, [-1.0, 1.0])
    assert broken.result == RESULTS.non_finite and jnp.isnan(broken.value)
    end = solved(root, [0.5, 0.3], max_iterations=60)
    assert end.result == RESULTS.successful
    np.testing.assert_allclose(end.x, [0.125, 0.125], rtol=1e-3)


def test_a_start_at_the_minimum_takes_no_step():
    end = solved(valley, [1.0, 1.0])
    assert end.num_steps == 0 and end.result == RESULTS.successful
