"""The solver of one problem on a convex one against CasADi's QP, and how it reports what it could not do."""

import casadi as ca
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from driftjax.core import RESULTS
from driftjax.solve import AbstractOCP, Options, shift, solve

N, LIMIT = 12, 0.6
A = np.array([[1.0, 0.1, 0.0], [0.0, 1.05, 0.1], [-0.05, 0.0, 1.1]])
B = np.array([[0.0, 0.02], [0.1, 0.0], [0.0, 0.1]])
Q, R, QN = np.diag([1.0, 2.0, 0.5]), np.diag([0.1, 0.3]), np.diag([5.0, 5.0, 5.0])


class Linear(AbstractOCP):
    """Unstable linear system, quadratic cost about a target in every row, inputs within +-LIMIT."""

    limit: Array

    def step(self, x, u, p):
        return jnp.asarray(A) @ x + jnp.asarray(B) @ u

    def cost(self, x, u, p):
        return 0.5 * (x - p) @ jnp.asarray(Q) @ (x - p) + 0.5 * u @ jnp.asarray(R) @ u

    def terminal(self, x, p):
        return 0.5 * (x - p) @ jnp.asarray(QN) @ (x - p)

    def constraints(self, x, u, p):
        return jnp.concatenate([self.limit + u, self.limit - u])


OCP = Linear(jnp.asarray(LIMIT))
run = eqx.filter_jit(lambda x0, p, U, options: solve(OCP, x0, p, jnp.zeros((N + 1, 3)), U, options))
batch = eqx.filter_jit(jax.vmap(lambda x0, p, U: solve(OCP, x0, p, jnp.zeros((N + 1, 3)), U, Options(1e-9))))


def starts(num: int, seed: int = 1):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (num, 3)), np.repeat(rng.uniform(-0.5, 0.5, (num, 1, 3)), N + 1, axis=1)


def dense_qp(x0, p):
    """Optimal states, inputs and cost of the same problem as one QP, by qpOASES with all states as variables."""
    X, U = ca.SX.sym("X", 3, N + 1), ca.SX.sym("U", 2, N)
    cost, dynamics = 0, [X[:, 0] - x0]
    for k in range(N):
        error = X[:, k] - p[k]
        cost += 0.5 * error.T @ Q @ error + 0.5 * U[:, k].T @ R @ U[:, k]
        dynamics.append(X[:, k + 1] - A @ X[:, k] - B @ U[:, k])
    error = X[:, N] - p[N]
    cost += 0.5 * error.T @ QN @ error
    problem = {"x": ca.vertcat(ca.vec(X), ca.vec(U)), "f": cost, "g": ca.vertcat(*dynamics)}
    qp = ca.qpsol("qp", "qpoases", problem, {"printLevel": "none"})
    bound = np.concatenate([np.full(3 * (N + 1), np.inf), np.full(2 * N, LIMIT)])
    out = qp(lbx=-bound, ubx=bound, lbg=0, ubg=0)
    z = np.asarray(out["x"]).ravel()
    return z[: 3 * (N + 1)].reshape(N + 1, 3), z[3 * (N + 1) :].reshape(N, 2), float(out["f"])


def test_the_optimum_with_active_input_bounds_is_that_of_a_quadratic_program():
    x0s, ps = starts(5)
    solutions = batch(jnp.asarray(x0s), jnp.asarray(ps), jnp.zeros((5, N, 2)))
    active = 0
    for i in range(5):
        X, U, cost = dense_qp(x0s[i], ps[i])
        active += int(np.sum(np.abs(U) > LIMIT - 1e-9))
        np.testing.assert_allclose(solutions.X[i], X, atol=1e-6)
        np.testing.assert_allclose(solutions.U[i], U, atol=1e-6)
        assert float(solutions.cost[i]) == pytest.approx(cost, rel=1e-7)
    assert active > 0  # else the bounds would not have been tested
    assert bool(jnp.all(solutions.result == RESULTS.successful))
    assert bool(jnp.all(jnp.maximum(solutions.kkt, solutions.violation) <= 1e-9))
    assert bool(jnp.all(jnp.abs(solutions.U) <= LIMIT + 1e-8))


def test_a_start_outside_the_bounds_ends_at_the_same_optimum():
    x0s, ps = starts(1)
    inside = run(jnp.asarray(x0s[0]), jnp.asarray(ps[0]), jnp.zeros((N, 2)), Options(1e-9))
    outside = run(jnp.asarray(x0s[0]), jnp.asarray(ps[0]), jnp.full((N, 2), 2 * LIMIT), Options(1e-9))
    assert inside.result == RESULTS.successful and outside.result == RESULTS.successful
    np.testing.assert_allclose(outside.U, inside.U, atol=1e-6)


def test_a_batch_gives_what_single_solves_give():
    x0s, ps = (jnp.asarray(a) for a in starts(3, seed=2))
    many = batch(x0s, ps, jnp.zeros((3, N, 2)))
    for i in range(3):
        single = run(x0s[i], ps[i], jnp.zeros((N, 2)), Options(1e-9))
        np.testing.assert_allclose(many.X[i], single.X, atol=1e-8)
        np.testing.assert_allclose(many.U[i], single.U, atol=1e-8)
        assert int(many.num_steps[i]) == int(single.num_steps)


def test_too_few_iterations_are_reported_and_not_hidden():
    """A quadratic program is solved in one iteration."""
    x0s, ps = starts(1)
    none, one = (run(jnp.asarray(x0s[0]), jnp.asarray(ps[0]), jnp.zeros((N, 2)), Options(1e-9, max_steps=n))
                 for n in (0, 1))  # fmt: skip
    assert none.result == RESULTS.not_converged and one.result == RESULTS.successful
    assert int(none.num_steps) == 0 and int(one.num_steps) == 1
    assert max(float(none.kkt), float(none.violation)) > 1e-9


def test_a_start_that_is_not_a_number_is_never_a_success():
    x0s, ps = starts(1)
    lost = run(jnp.asarray([np.nan, 0.0, 0.0]), jnp.asarray(ps[0]), jnp.zeros((N, 2)), Options(1e-9))
    assert lost.result != RESULTS.successful


def test_more_iterations_and_tolerances_share_one_compiled_program():
    traces = []

    @eqx.filter_jit
    def counted(x0, p, options):
        traces.append(1)
        return solve(OCP, x0, p, jnp.zeros((N + 1, 3)), jnp.zeros((N, 2)), options)

    x0s, ps = (jnp.asarray(a) for a in starts(1))
    for options in (Options(1e-6), Options(1e-3, 0.1, 5)):
        counted(x0s[0], ps[0], options)
    assert len(traces) == 1


def test_shift_drops_the_first_row_and_repeats_the_last():
    np.testing.assert_array_equal(shift(jnp.arange(6.0).reshape(3, 2)), [[2, 3], [4, 5], [4, 5]])
