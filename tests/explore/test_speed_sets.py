"""V-sets against SciPy's bounded least squares and cases worked out by hand."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from driftjax.core import RESULTS
from driftjax.explore import v_sets

N = 25
BOUNDS = jnp.array([[-0.2, 0.2], [-0.5, 0.5], [-1.0, 1.0], [-3.0, 3.0]])


def corner(seed=0):
    """A corner entered fast, with a lateral error that comes and goes."""
    rng = np.random.default_rng(seed)
    s = np.cumsum(rng.uniform(0.6, 1.6, N))
    V = 12.0 + 1.5 * np.cos(2 * np.pi * s / s[-1])
    e = 1.2 * np.sin(np.pi * s / s[-1]) + 0.3 * rng.normal(size=N)
    return V, s, np.full(N, 0.8), e


@eqx.filter_jit
def sets(V, s, r_b, e, w1: Any = 1.0, w2: Any = 1.0, V_min: Any = 9.0, V_max: Any = 13.2, section=None):
    return v_sets(V, s, r_b, e, w1=w1, w2=w2, gamma_bounds=BOUNDS, V_min=V_min, V_max=V_max, section=section)


def cost(gamma, V, s, r_b, e, w1, w2):
    """The sum of the paper, term by term."""
    phi = {k: np.arctan((V[k] + gamma[k] - V[k - 1] - gamma[k - 1]) / (s[k] - s[k - 1])) for k in range(1, N)}
    smooth = sum(((phi[k] - phi[k - 1]) / (s[k] - s[k - 1])) ** 2 for k in range(2, N))
    return w1 * smooth + w2 * np.sum((gamma - r_b * e) ** 2)


@pytest.mark.parametrize(("w1", "w2", "seed"), [(1.0, 1.0, 0), (50.0, 1.0, 1), (0.01, 2.0, 2), (500.0, 0.5, 3)])
def test_equals_scipys_bounded_least_squares(w1, w2, seed):
    V, s, r_b, e = corner(seed)
    ours = sets(*(jnp.asarray(v) for v in (V, s, r_b, e)), w1=jnp.asarray(w1), w2=jnp.asarray(w2))
    assert jnp.all(ours.result == RESULTS.successful)

    def residuals(gamma):
        slope = np.arctan(np.diff(V + gamma) / np.diff(s))
        return np.concatenate([np.sqrt(w1) * np.diff(slope) / np.diff(s)[1:], np.sqrt(w2) * (gamma - r_b * e)])

    for k, (low, high) in enumerate(np.asarray(BOUNDS)):
        lower, upper = np.clip(low, 9.0 - V, 13.2 - V) - 1e-12, np.clip(high, 9.0 - V, 13.2 - V) + 1e-12
        start = 0.5 * (lower + upper)
        other = least_squares(residuals, start, bounds=(lower, upper), xtol=1e-14, ftol=1e-14, gtol=1e-12)
        gamma = np.asarray(ours.gamma[k])
        assert np.all(gamma >= lower) and np.all(gamma <= upper)
        assert cost(gamma, V, s, r_b, e, w1, w2) <= 2 * other.cost * (1 + 1e-8)
        np.testing.assert_allclose(gamma, other.x, atol=2e-4)


def test_without_smoothing_the_increment_is_the_clipped_target():
    V, s, r_b, e = (jnp.asarray(v) for v in corner())
    ours = sets(V, s, r_b, e, jnp.asarray(0.0), jnp.asarray(1.0))
    for gamma, (low, high) in zip(ours.gamma, BOUNDS, strict=True):
        expected = jnp.clip(jnp.clip(r_b * e, low, high), 9.0 - V, 13.2 - V)
        np.testing.assert_allclose(gamma, expected, atol=1e-9)


def test_on_a_straight_speed_line_with_constant_error_the_target_is_met():
    s = jnp.linspace(0.0, 24.0, N)
    ours = sets(jnp.full(N, 12.0), s, jnp.full(N, 0.8), jnp.full(N, -0.5))
    np.testing.assert_allclose(ours.V_ep, [11.8, 11.6, 11.6, 11.6], atol=1e-7)
    np.testing.assert_array_equal(ours.distinct, [True, True, False, False])


def test_direction_is_right_for_both_turns():
    V, s, r_b, e = (jnp.asarray(v) for v in corner())
    inside_left = sets(V, s, r_b, jnp.abs(e))
    inside_right = sets(V, s, -r_b, -jnp.abs(e))
    assert jnp.all(inside_left.V_ep > V.mean() - 0.2)
    np.testing.assert_allclose(inside_left.V_ep, inside_right.V_ep, rtol=1e-9)
    outside = sets(V, s, r_b, -jnp.abs(e))
    assert jnp.all(outside.V_ep < inside_left.V_ep)


def test_speed_is_averaged_over_the_drift_section():
    V, s, r_b, e = (jnp.asarray(v) for v in corner())
    section = (jnp.arange(N) > 5) & (jnp.arange(N) < 17)
    ours = sets(V, s, r_b, e, section=section)
    np.testing.assert_allclose(ours.V_ep, ours.V[:, 6:17].mean(axis=1), rtol=1e-12)


def test_limits_the_wrong_way_round_are_infeasible_and_others_go_before_the_bounds():
    V, s, r_b, e = (jnp.asarray(v) for v in corner())
    assert jnp.all(sets(V, s, r_b, e, V_max=jnp.asarray(8.0)).result == RESULTS.infeasible)
    slow = sets(V, s, r_b, e, V_max=jnp.asarray(11.0))  # the plan is up to 2.5 m/s above
    assert jnp.all(slow.result == RESULTS.successful) and jnp.max(slow.V) <= 11.0 + 1e-12


def test_a_batch_equals_single_calls():
    corners = [tuple(jnp.asarray(v) for v in corner(seed)) for seed in (4, 5)]
    batch = jax.jit(jax.vmap(lambda V, s, r_b, e: sets(V, s, r_b, e)))(
        *(jnp.stack(parts) for parts in zip(*corners, strict=True))
    )
    for i, one_corner in enumerate(corners):
        np.testing.assert_allclose(batch.gamma[i], sets(*one_corner).gamma, atol=1e-9)
