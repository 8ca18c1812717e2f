"""The drift MPC for batches is the drift MPC of closed-loop laps, less path and actuators."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.lanes import drift_lanes, tracked
from driftjax.control.mpc import MPCConfig, Reference, Weights, drift_ocp
from driftjax.core import BadInput
from driftjax.gp import zero_gp
from driftjax.vehicle import load_vehicle, no_residual

CAR, CONFIG = "sedan", MPCConfig(horizon=4)
X, U, BEFORE = np.array([8.7, -0.6, 1.2]), np.array([-0.2, 6.0]), np.array([-0.25, 6.5])


def test_step_derivatives_and_costs_are_those_of_the_whole_problem():
    car = load_vehicle(CAR)
    whole = drift_ocp(CONFIG, Weights(), car, no_residual(zero_gp(1, 5, 3)))
    batched = drift_lanes(CONFIG, Weights(), car)
    flat = jnp.full(5, 0.0)
    reference = Reference(flat + 9.0, flat - 0.55, flat + 1.1, flat, flat, flat)
    here = jax.tree.map(lambda row: row[0], reference)
    before = BEFORE * [1.0, 1000.0]
    x = jnp.concatenate([X, jnp.zeros(2), before, before]) / whole.x_scale
    u = jnp.asarray(U * [1.0, 1000.0]) / whole.u_scale
    to_si = np.asarray(whole.x_scale[:3])
    A, B = whole.jacobian(x, u, here)
    components = [jnp.array([value]) for value in X], [jnp.array([value]) for value in U]
    y, M = batched.linearise(*components, [leaf[:1] for leaf in tracked(reference)])
    np.testing.assert_allclose(np.ravel(y), np.asarray(whole.step(x, u, here))[:3] * to_si, rtol=1e-13)
    found = np.array([[np.ravel(entry)[0] for entry in row] for row in M])
    np.testing.assert_allclose(found[:, :3], np.asarray(A)[:3, :3] * to_si[:, None] / to_si, atol=1e-12)
    per_input = to_si[:, None] / np.asarray(whole.u_scale) * [1.0, 1000.0]
    np.testing.assert_allclose(found[:, 3:], np.asarray(B)[:3] * per_input, atol=1e-12)
    cost = batched.cost(*components, [leaf[:1] for leaf in tracked(reference)])
    change = sum(r * (a - b) ** 2 for r, a, b in zip(batched.R, U, BEFORE, strict=True))
    np.testing.assert_allclose(cost[0] + change, whole.cost(x, u, here), rtol=1e-12)


def test_weights_on_the_path_are_refused():
    with pytest.raises(BadInput, match="no weights on the path"):
        drift_lanes(CONFIG, Weights(Q_path=(1.0, 0.0)), load_vehicle(CAR))
