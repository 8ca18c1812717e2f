"""Implicit derivatives of the solver on a convex problem: state, parameters, limits; what has none says so."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import RESULTS
from driftjax.solve import AbstractOCP, Options, solve

N = 8


class Pendulum(AbstractOCP):
    """An unstable pendulum with a bounded torque, and a bounded rate at the end."""

    weight: Array
    limit: Array
    end: Array

    def step(self, x, u, p):
        return jnp.stack([x[0] + 0.2 * x[1], x[1] + 0.2 * (jnp.sin(x[0]) + u[0])])

    def cost(self, x, u, p):
        return 0.5 * (self.weight * (x[0] - p) ** 2 + 0.1 * x[1] ** 2 + 0.05 * u[0] ** 2)

    def terminal(self, x, p):
        return self.weight * (x[0] - p) ** 2

    def constraints(self, x, u, p):
        return jnp.concatenate([self.limit + u, self.limit - u])

    def terminal_constraints(self, x, p):
        return jnp.stack([self.end - x[1], self.end + x[1]])


def plan(theta, max_steps):
    """From weight, limits of torque and rate, first state, target and guess of the torque."""
    weight, limit, end, angle, rate, target, guess = theta
    x0, p = jnp.stack([angle, rate]), jnp.full(N + 1, target)
    options = Options(1e-9, 1.0, max_steps)
    return solve(Pendulum(weight, limit, end), x0, p, jnp.zeros((N + 1, 2)), jnp.full((N, 1), guess), options)


def pick(theta, max_steps):
    solution = plan(theta, max_steps)
    values = jnp.concatenate([solution.U[:, 0], solution.X.ravel(), solution.cost[None]])
    return values, (solution, values)


FREE, LIMITED = jnp.array([1.0, 5.0, 5.0, 0.3, 0.1, 0.2, 0.0]), jnp.array([1.0, 0.8, 0.05, 0.5, 0.2, 0.0, 0.0])
both = jnp.stack([FREE, LIMITED])
H = 1e-4
STEPS = H * jnp.concatenate([jnp.zeros((1, 7)), jnp.eye(7), -jnp.eye(7)])
AROUND = (both[:, None] + STEPS).reshape(-1, 7)
forward = eqx.filter_jit(jax.vmap(jax.jacfwd(pick, has_aux=True), in_axes=(0, None)))


def test_derivatives_equal_central_differences():
    slopes, (solution, values) = forward(AROUND, jnp.asarray(80))
    assert bool(jnp.all(solution.result == RESULTS.successful))
    limited = len(STEPS)  # the first row of the second case
    assert int(jnp.sum(jnp.abs(solution.U[limited]) > 0.8 - 1e-8)) >= 2
    assert float(abs(solution.X[limited, -1, 1])) > 0.05 - 1e-6
    values, slopes = (a.reshape(2, len(STEPS), *a.shape[1:]) for a in (values, slopes))
    apart = jnp.swapaxes(values[:, 1:8] - values[:, 8:], 1, 2) / (2 * H)
    np.testing.assert_allclose(slopes[:, 0], apart, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(slopes[..., 6], 0.0)  # a guess carries no derivative
    backward = eqx.filter_jit(jax.vmap(lambda t: jax.jacrev(lambda t: pick(t, 80)[0])(t)))(both)
    np.testing.assert_allclose(backward, slopes[:, 0], rtol=1e-8, atol=1e-10)


def test_a_solve_that_does_not_converge_has_no_derivative():
    slopes, (solution, _) = forward(AROUND, jnp.asarray(2))
    assert not bool(jnp.any(solution.result == RESULTS.successful))
    assert bool(jnp.all(jnp.isnan(slopes[:, :N])))
