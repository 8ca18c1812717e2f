"""Drifts of a corrected car: followed from the nominal root, and honest where that breaks."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import RESULTS, features
from driftjax.equilibrium import Branch, SlipRadius, continuation, solve_nominal
from driftjax.gp import Hyper, condition, data_scales, zero_gp
from driftjax.vehicle import Corrected, load_vehicle

CAR = load_vehicle("sedan").build()
FIXED = SlipRadius(-0.45, 15.0)


class Missing(eqx.Module):
    """A synthetic model error: some drag, some drift torque."""

    size: jax.Array

    def __call__(self, z):
        return self.size * jnp.stack([-4e-4 * z[0] ** 2, 0.05 * z[1], 0.4 * z[1] + 0.2 * z[3]])


@eqx.filter_jit
def fitted_gp(d, rows=60):
    """A GP that has seen `d` around the nominal drift."""
    centre = jnp.array([12.0, -0.45, 0.8, -0.2, 7e3])
    spread = jnp.array([2.0, 0.2, 0.15, 0.25, 3e3])
    Z = centre + spread * jax.random.uniform(jax.random.key(0), (rows, 5), minval=-1.0, maxval=1.0)
    Y, mask = jax.vmap(d)(Z), jnp.ones(rows, bool)
    hyper = Hyper(jnp.log(3.0) * jnp.ones((3, 5)), jnp.zeros(3), jnp.full(3, jnp.log(1e-3)))
    return condition(Z, Y, mask, hyper, *data_scales(Z, Y, mask), "se")


@eqx.filter_jit
def follow(residual, fixed):
    start = solve_nominal(CAR, fixed, branch=Branch.COUNTERSTEER)
    return continuation(CAR, residual, fixed, (start.x, start.u), branch=Branch.COUNTERSTEER)


@eqx.filter_jit
def plain_drift():
    return solve_nominal(CAR, FIXED, branch=Branch.COUNTERSTEER)


def test_a_gp_without_data_leaves_the_nominal_drift():
    plain = plain_drift()
    out = follow(zero_gp(60, 5, 3).bounded_mean, FIXED)
    assert out.result == RESULTS.successful and out.eta == 1
    np.testing.assert_allclose([out.x.V, out.u.delta], [plain.x.V, plain.u.delta], rtol=1e-9)


def test_learnt_drift_is_the_drift_of_the_true_car():
    d = Missing(jnp.asarray(1.0))
    truth, gp = follow(d, FIXED), fitted_gp(d)
    out = follow(gp.bounded_mean, FIXED)
    plain = plain_drift()
    assert out.result == RESULTS.successful and out.eta == 1 and out.kind == Branch.COUNTERSTEER
    assert eqx.filter_jit(gp.fade)(features(out.x, out.u)) > 0.99
    for pick in (lambda e: e.x.V, lambda e: e.u.delta, lambda e: e.u.Fxr):
        ours, true, uncorrected = (float(pick(e)) for e in (out, truth, plain))
        assert abs(ours - true) < 0.1 * abs(uncorrected - true)
    dx = eqx.filter_jit(Corrected(CAR, gp.bounded_mean))(out.x, out.u)
    assert np.max(np.abs(dx)) < 1e-7


def test_too_large_an_error_is_reported_with_how_far_it_came():
    out = follow(Missing(jnp.asarray(60.0)), FIXED)
    assert out.result != RESULTS.successful and out.eta < 1


def test_no_nominal_drift_is_not_a_success():
    out = follow(Missing(jnp.asarray(1.0)), SlipRadius(0.45, 15.0))
    assert out.result != RESULTS.successful


@pytest.mark.slow
def test_gradient_through_the_continuation_equals_central_differences():
    def steer(size):
        return follow(Missing(size), FIXED).u.delta

    size, h = jnp.asarray(0.7), 1e-4
    difference = (steer(size + h) - steer(size - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(steer)(size), difference, rtol=1e-5)
    assert abs(difference) > 1e-3
