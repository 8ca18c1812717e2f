"""Derivatives of the converged drift MPC against central differences of solves at a tight tolerance."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.mpc import Reference, drift_ocp
from driftjax.control.mpc_solution import MPCSolution, solve_mpc
from driftjax.core import RESULTS
from driftjax.gp import zero_gp
from driftjax.solve import Options
from driftjax.studies.bench.drift import U_REF, WEIGHTS, X_REF, car, config
from driftjax.vehicle import no_residual

pytestmark = pytest.mark.slow  # compiles for a minute; tests/control/test_drift_mpc.py has the case without limits
N = 10
UNIT = np.array([1.0, 1e4])  # of commands
# start from the reference drift in V, beta, r; how many input limits and rate limits then hold
CASES = {
    "free": ((0.02, 0.003, -0.003), 0, 0),
    "little drive": ((0.0, 0.1, 0.1), 4, 4),
    "full drive": ((0.0, -0.1, -0.1), 8, 2),
}
THETA = 5 + 3 + 1 + 2  # logarithms of Q and R, state, friction, last command


@cache
def ocp():
    return drift_ocp(config(N), WEIGHTS, car(), no_residual(zero_gp(4, 5, 3)))


def theta(name: str) -> np.ndarray:
    return np.concatenate([np.zeros(5), CASES[name][0], [float(ocp().nominal.tyre.mu)], U_REF / UNIT])


def solved(theta, max_steps=100) -> MPCSolution:
    base = ocp()
    weights = jnp.exp(theta[:5])
    Q = base.Q * jnp.concatenate([weights[:3], jnp.ones(2)])
    now = eqx.tree_at(lambda o: (o.Q, o.R, o.nominal.tyre.mu), base, (Q, base.R * weights[3:], theta[8]))
    reference = Reference(*(jnp.full(N + 1, value) for value in (*X_REF, 0.0, 0.0, 0.0)))
    x, before = jnp.array([*X_REF, 0.0, 0.0]).at[:3].add(theta[5:8]), theta[9:] * UNIT
    X, U = jnp.tile(jnp.array([*X_REF, 0.0, 0.0]), (N + 1, 1)), jnp.tile(jnp.asarray(U_REF), (N, 1))
    return solve_mpc(now, x, before, before, reference, X, U, Options(1e-9, 1.0, max_steps))


def commands(theta, max_steps):
    """Command applied (2,) and planned inputs (N, 2), over `UNIT`; beside them the latter and whether it converged."""
    solution = solved(theta, max_steps)
    inputs = solution.U / UNIT
    return (jnp.stack(solution.u) / UNIT, inputs), (inputs, solution.plan.result == RESULTS.successful)


forward = eqx.filter_jit(jax.vmap(jax.jacfwd(commands, has_aux=True), in_axes=(0, None)))


# Directions in which all parameters change at once, each by its sign.
DIRECTIONS = np.random.default_rng(0).choice([-1.0, 1.0], (2, THETA))


@cache
def around(h: float = 1e-5):
    """Derivatives and values at each case, and at steps of `h` along the directions to both sides of it."""
    steps = h * np.concatenate([np.zeros((1, THETA)), DIRECTIONS, -DIRECTIONS])
    points = np.concatenate([theta(name) + steps for name in CASES])
    slopes_and_values = jax.tree.map(np.asarray, forward(jnp.asarray(points), jnp.asarray(100)))
    return jax.tree.map(lambda a: a.reshape(len(CASES), len(steps), *a.shape[1:]), slopes_and_values)


@pytest.mark.parametrize("name", CASES)
def test_derivatives_equal_central_differences_with_and_without_active_limits(name, h=1e-5):
    (first, planned), (inputs, converged) = jax.tree.map(lambda a: a[list(CASES).index(name)], around(h))
    assert np.all(converged)
    o, U = ocp(), inputs[0] * UNIT
    held = lambda gap: int(np.sum(np.abs(gap / np.asarray(o.u_scale)) < 1e-6))
    change = np.abs(np.diff(U, axis=0, prepend=U_REF[None]))
    limits = held(U - np.asarray(o.lower)) + held(np.asarray(o.upper) - U)
    assert (limits, held(change - np.asarray(o.rate))) == CASES[name][1:]
    num = len(DIRECTIONS)
    apart = np.moveaxis((inputs[1 : num + 1] - inputs[num + 1 :]) / (2 * h), 0, -1)
    assert np.sum(np.abs(planned[0]).max((0, 1)) > 1e-4) >= THETA - 1  # at full drive one weight is without effect
    size = np.abs(apart).max((0, 1))
    np.testing.assert_array_less(np.abs(planned[0] @ DIRECTIONS.T - apart).max((0, 1)), 1e-4 * size)
    np.testing.assert_array_less(np.abs(first[0] @ DIRECTIONS.T - apart[0]).max(0), 1e-4 * size)


def test_a_solve_that_does_not_converge_has_no_derivative():
    points = jnp.tile(jnp.asarray(theta("full drive")), (around()[1][1].size, 1))
    slopes, (_, converged) = forward(points, jnp.asarray(3))
    assert not bool(jnp.any(converged))
    assert all(bool(jnp.all(jnp.isnan(slope))) for slope in slopes)


def test_reverse_mode_equals_forward_mode():
    points = jnp.stack([jnp.asarray(theta(name)) for name in CASES])
    reverse = eqx.filter_jit(jax.vmap(lambda theta: jax.jacrev(lambda t: commands(t, 100)[0])(theta)))(points)
    for back, ahead in zip(reverse, around()[0], strict=True):
        np.testing.assert_allclose(back, ahead[:, 0], rtol=1e-6, atol=1e-8)
