"""Implicit derivatives of a batch of solutions: problem, states, parameters, limits; what has none says so."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import RESULTS
from driftjax.solve import AbstractBatchOCP, BatchSolution, Options, solve_batch

N = 8


class Pendulum(AbstractBatchOCP):
    """An unstable pendulum with limits on torque, its change, and rate; fields are (1,) or (batch,)."""

    weight: Array
    torque: Array
    change: Array
    speed: Array

    def step(self, x, u, p):
        return [x[0] + 0.2 * x[1], x[1] + 0.2 * (jnp.sin(x[0]) + u[0])]

    def cost(self, x, u, p):
        return 0.5 * (self.weight * (x[0] - p) ** 2 + 0.1 * x[1] ** 2 + 0.05 * u[0] ** 2)

    def terminal(self, x, p):
        return self.weight * (x[0] - p) ** 2

    def rate_weight(self):
        return (0.1 * self.weight,)

    def input_limits(self):
        return ((-self.torque, self.torque),)

    def change_limits(self):
        return ((-self.change, self.change),)

    def state_limits(self):
        return ((None, None), (-self.speed, self.speed))


# weight, limits of torque, its change and the rate, first angle and rate, last torque, target, guess of the torque
FREE = [1.0, 5.0, 5.0, 5.0, 0.3, 0.1, 0.05, 0.2, 0.0]
LIMITED = [4.0, 0.8, 0.5, 0.35, 0.3, 0.2, 0.1, -0.6, 0.0]
THETA = len(FREE)
BOTH = jnp.array([FREE, LIMITED])
H = 1e-4
STEPS = H * jnp.concatenate([jnp.zeros((1, THETA)), jnp.eye(THETA), -jnp.eye(THETA)])
AROUND = (BOTH[:, None] + STEPS).reshape(-1, THETA).T


def plan(theta: Array, max_steps: Array | int):
    """Solve a batch from parameters (THETA, batch)."""
    weight, torque, change, speed, angle, rate, before, target, guess = theta
    p, X = jnp.broadcast_to(target, (N + 1, *target.shape)), jnp.zeros((2, N + 1, *target.shape))
    U = jnp.broadcast_to(guess, (1, N, *target.shape))
    ocp = Pendulum(weight, torque, change, speed)
    options = Options(1e-9, 1.0, max_steps)
    return solve_batch(ocp, jnp.stack([angle, rate]), before[None], p, X, U, options)


def values(solution) -> Array:
    return jnp.concatenate([solution.U[0], *solution.X, solution.cost[None]])


@eqx.filter_jit
def forward(theta: Array, max_steps: Array):
    """Return the derivatives by each parameter of an entry (values, THETA, batch), the solution, and its values."""

    def along(direction: Array):
        tangent = jnp.broadcast_to(direction[:, None], theta.shape)
        solved = lambda theta: (lambda s: (values(s), s))(plan(theta, max_steps))
        return jax.jvp(solved, (theta,), (tangent,), has_aux=True)

    value, slopes, solution = jax.vmap(along, out_axes=(None, 1, None))(jnp.eye(THETA))
    return slopes, solution, value


def test_derivatives_equal_central_differences_with_and_without_active_limits():
    slopes, solution, value = forward(AROUND, jnp.asarray(60))
    assert bool(jnp.all(solution.result == RESULTS.successful))
    limited = len(STEPS)  # the first of the second case
    torque, speed = solution.U[0, :, limited], solution.X[1, 1:, limited]
    assert int(jnp.sum(jnp.abs(torque) > 0.8 - 1e-7)) >= 1
    assert int(jnp.sum(jnp.abs(jnp.diff(torque, prepend=0.1)) > 0.5 - 1e-7)) >= 1
    assert int(jnp.sum(jnp.abs(speed) > 0.35 - 1e-7)) >= 1
    value, slopes = (a.reshape(*a.shape[:-1], 2, len(STEPS)) for a in (value, slopes))
    apart = (value[..., 1 : THETA + 1] - value[..., THETA + 1 :]) / (2 * H)
    np.testing.assert_allclose(jnp.moveaxis(slopes[..., 0], 1, -1), apart, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(slopes[:, -1], 0.0)  # a guess carries no derivative


def test_reverse_mode_equals_forward_mode():
    back = eqx.filter_jit(jax.jacrev(lambda theta: values(plan(theta, 60))))(BOTH.T)
    ahead = forward(BOTH.T, jnp.asarray(60))[0]
    for entry in range(2):
        np.testing.assert_allclose(back[:, entry, :, entry], ahead[:, :, entry], rtol=1e-8, atol=1e-10)
        np.testing.assert_array_equal(back[:, entry, :, 1 - entry], 0.0)  # entries are independent


def test_a_solve_that_does_not_converge_has_no_derivative_and_leaves_its_neighbours_theirs():
    steps = jnp.array([60, 2])
    slopes, solution, _ = forward(BOTH.T, steps)
    np.testing.assert_array_equal(solution.result == RESULTS.successful, [True, False])
    assert bool(jnp.all(jnp.isnan(slopes[: N + 1, :-1, 1])))
    np.testing.assert_array_equal(slopes[..., 0], forward(BOTH.T, jnp.asarray(60))[0][..., 0])


class Saddle(Pendulum):
    """Has a stationary point that is no minimum."""

    def cost(self, x, u, p):
        return -((x[0] - p) ** 2) - 0.5 * u[0] ** 2


def test_a_point_that_is_no_minimum_has_no_derivative():
    one = jnp.ones(1)

    def torque(angle: Array) -> tuple[Array, BatchSolution]:
        x0, X = jnp.stack([angle, 0 * one]), jnp.zeros((2, N + 1, 1))
        ocp = Saddle(0 * one, 5 * one, 5 * one, 5 * one)
        solution = solve_batch(
            ocp, x0, 0 * one[None], jnp.zeros((N + 1, 1)), X, jnp.zeros((1, N, 1)), Options(1e-3, 1e-12)
        )
        return solution.U[0], solution

    _, slope, solution = eqx.filter_jit(lambda x: jax.jvp(torque, (x,), (one,), has_aux=True))(0 * one)
    assert bool(solution.result == RESULTS.successful)
    assert bool(jnp.all(jnp.isnan(slope)))
