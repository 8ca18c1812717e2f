"""The batched solver: a problem that is no car against SciPy, failures kept to their entry, one real-time iteration."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy.optimize import minimize

from driftjax.core import RESULTS
from driftjax.solve import Options
from driftjax.solve.batch import solve_batch
from driftjax.solve.batch_ocp import AbstractBatchOCP

N, DT = 12, 0.1


class Pendulum(AbstractBatchOCP):
    """Swings a pendulum towards `p` [rad] with bounded torque and speed; one input."""

    torque: float = 2.0
    speed: float = 1.0

    def step(self, x, u, p):
        rate = x[1] + DT * (u[0] - jnp.sin(x[0]))
        return [x[0] + DT * rate, rate]

    def cost(self, x, u, p):
        return (x[0] - p) ** 2 + 0.01 * u[0] ** 2

    def terminal(self, x, p):
        return 5 * (x[0] - p) ** 2

    def rate_weight(self):
        return (0.02,)

    def input_limits(self):
        return ((-self.torque, self.torque),)

    def state_limits(self):
        return ((None, None), (-self.speed, self.speed))


def problem(dtype: type = np.float64) -> tuple[Array, ...]:
    x0 = jnp.asarray([[0.0, 0.5, -0.3, 1.0], [0.0, 0.4, 0.0, -0.2]], dtype)
    target = jnp.asarray([0.6, 1.0, -0.8, 0.2], dtype)
    u_before = jnp.zeros((1, 4), dtype)
    X = jnp.broadcast_to(x0[:, None], (2, N + 1, 4))
    return x0, u_before, jnp.broadcast_to(target, (N + 1, 4)), X, jnp.zeros((1, N, 4), dtype)


def scipys(ocp: Pendulum, entry: int) -> np.ndarray:
    x0, before, p, _, _ = (np.asarray(a)[..., entry] for a in problem())

    def states(U):
        x = [x0]
        for u in U:
            rate = x[-1][1] + DT * (u - np.sin(x[-1][0]))
            x.append(np.array([x[-1][0] + DT * rate, rate]))
        return np.array(x)

    def cost(U):
        x = states(U)
        away = (x[:, 0] - p) ** 2
        return away[:-1].sum() + 5 * away[-1] + 0.01 * (U**2).sum() + 0.02 * (np.diff(U, prepend=before) ** 2).sum()

    speed = {"type": "ineq", "fun": lambda U: ocp.speed - np.abs(states(U)[1:, 1])}
    bounds = [(-ocp.torque, ocp.torque)] * N
    solution = minimize(cost, np.zeros(N), method="SLSQP", bounds=bounds, constraints=[speed], options={"ftol": 1e-14})
    assert solution.success
    return solution.x


@eqx.filter_jit
def solved(ocp, args, options):
    x0, before, p, X, U = args
    return solve_batch(ocp, x0, before, p, X, U, options)


def test_a_bounded_pendulum_is_swung_as_scipy_swings_it():
    ocp = Pendulum()
    plans = solved(ocp, problem(), Options(1e-8))
    assert bool(jnp.all(plans.result == RESULTS.successful))
    assert float(jnp.max(jnp.abs(plans.U))) <= ocp.torque + 1e-8
    assert float(jnp.max(jnp.abs(plans.X[1]))) <= ocp.speed + 1e-8
    assert float(jnp.max(jnp.abs(plans.U))) > 0.99 * ocp.torque  # else no limit would have been tested
    assert float(jnp.max(jnp.abs(plans.X[1]))) > 0.99 * ocp.speed
    for entry in range(4):
        np.testing.assert_allclose(plans.U[0, :, entry], scipys(ocp, entry), atol=2e-5)


class Straight(Pendulum):
    """Leaves the curvature of the dynamics out of the first iterations."""

    def early_curvature(self, x, u, costate, p, more):
        return [[None] * 3 for _ in range(3)]


def test_cheaper_second_derivatives_lead_to_the_same_plan_later():
    many = tuple(jnp.tile(a, 16) for a in problem())  # small batches do not use them
    exact, cheap = (solved(ocp, many, Options(1e-10)) for ocp in (Pendulum(), Straight()))
    assert bool(jnp.all(cheap.result == RESULTS.successful))
    assert bool(jnp.any(cheap.num_steps > exact.num_steps))  # else the cheaper ones would not have been used
    np.testing.assert_allclose(cheap.U, exact.U, atol=1e-8)


def test_single_precision_finds_the_same_plan():
    double = solved(Pendulum(), problem(), Options(1e-8))
    single = solved(Pendulum(), problem(np.float32), Options(1e-4))
    assert single.U.dtype == jnp.float32
    assert bool(jnp.all(single.result == RESULTS.successful))
    np.testing.assert_allclose(single.X, double.X, atol=5e-3)
    assert float(jnp.max(jnp.abs(single.U))) <= Pendulum().torque + 1e-6


def test_an_entry_that_fails_says_so_and_leaves_the_others_alone():
    x0, before, p, X, U = problem()
    alone = solved(Pendulum(), (x0, before, p, X, U), Options(1e-8))
    broken = solved(Pendulum(), (x0.at[0, 1].set(jnp.nan), before, p, X.at[1, 0, 3].set(0.0), U), Options(1e-8))
    assert bool((broken.result == RESULTS.non_finite)[1])
    for entry in (0, 2, 3):
        assert bool((broken.result == RESULTS.successful)[entry])
        np.testing.assert_array_equal(broken.U[..., entry], alone.U[..., entry])
    few = solved(Pendulum(), (x0, before, p, X, U), Options(1e-8, max_steps=2))
    assert bool(jnp.all(few.result == RESULTS.not_converged))


@pytest.mark.parametrize("copies", [1, 16])  # of 64 entries and more, the last go on by themselves
def test_every_entry_has_its_own_tolerance_and_steps(copies):
    """No entry depends on the options of another: a batch of laps may hold laps of other settings."""
    args = tuple(jnp.tile(a, copies) for a in problem())
    options = Options(jnp.tile(jnp.array([1e-8, 1e-2, 1e-8, 1e-2]), copies), 0.1,
                      jnp.tile(jnp.array([60, 60, 2, 60]), copies))  # fmt: skip
    mixed = solved(Pendulum(), args, options)
    for entry, (tolerance, steps) in enumerate([(1e-8, 60), (1e-2, 60), (1e-8, 2), (1e-2, 60)]):
        alone = solved(Pendulum(), problem(), Options(tolerance, 0.1, steps))
        here = mixed.U[..., entry::4]
        np.testing.assert_allclose(here, alone.U[..., entry : entry + 1] + jnp.zeros_like(here), rtol=1e-9, atol=1e-12)
        assert bool(jnp.all((mixed.result == RESULTS.successful)[entry::4])) == (steps == 60)
    assert float(mixed.kkt[1]) > 1e-6  # else its tolerance would not have been its own


def test_only_what_is_not_solved_is_solved_again():
    args, allowed = problem(), jnp.array([60, 2, 60, 2])
    once, again = (solved(Pendulum(), args, Options(1e-8, 1.0, allowed, restarts=n)) for n in (0, 2))
    np.testing.assert_array_equal(again.result == RESULTS.successful, [True, False, True, False])
    np.testing.assert_array_equal(again.num_steps, once.num_steps * np.array([1, 3, 1, 3]))
    np.testing.assert_array_equal(again.U[..., ::2], once.U[..., ::2])
    accepted = solved(Pendulum(), args, Options(1e-8, 1.0, allowed, implicit=1e12, restarts=2))
    np.testing.assert_array_equal(accepted.num_steps, once.num_steps)


class Valley(AbstractBatchOCP):
    """Moves to the smallest sqrt(1 + x^2): Newton's full steps lead from x to -x^3, away from 0 where |x| > 1."""

    def step(self, x, u, p):
        return [x[0] + u[0]]

    def cost(self, x, u, p):
        return jnp.zeros_like(u[0])

    def terminal(self, x, p):
        return jnp.sqrt(1 + x[0] ** 2)


def test_the_line_search_of_a_restart_solves_what_full_steps_do_not():
    x0 = jnp.array([[0.5, -3.0, 20.0, 5.0]])
    args = (x0, jnp.zeros((1, 4)), jnp.zeros((2, 4)), jnp.stack([x0, x0], axis=1), jnp.zeros((1, 1, 4)))
    full, searched = (solved(Valley(), args, Options(1e-8, restarts=n)) for n in (0, 1))
    np.testing.assert_array_equal(full.result == RESULTS.successful, [True, False, False, False])
    assert bool(jnp.all(searched.result == RESULTS.successful))
    np.testing.assert_allclose(searched.X[0, 1], 0.0, atol=1e-8)


class PricedValley(Valley):
    """The same with an input cost."""

    def cost(self, x, u, p):
        return 0.1 * u[0] ** 2


def test_a_problem_without_limits_is_solved():
    x0 = jnp.array([[0.5, -0.7]])
    args = (x0, jnp.zeros((1, 2)), jnp.zeros((2, 2)), jnp.stack([x0, x0], axis=1), jnp.zeros((1, 1, 2)))
    end = solved(PricedValley(), args, Options(1e-10))
    assert bool(jnp.all(end.result == RESULTS.successful))
    x = end.X[0, 1]
    np.testing.assert_allclose(x / jnp.sqrt(1 + x**2) + 0.2 * (x - x0[0]), 0.0, atol=1e-9)


def test_real_time_iterations_lead_to_the_solution():
    """One iteration solves its program; the residual that it reports is that of the problem."""
    x0, before, p, X, U = problem()
    best = solved(Pendulum(), (x0, before, p, X, U), Options(1e-8))
    kkt = []
    for _ in range(8):
        plans = solved(Pendulum(), (x0, before, p, X, U), Options(1e-9, 1.0, 1))
        assert bool(jnp.all(plans.qp_error <= 1e-9)) and bool(jnp.all(plans.num_steps == 1))
        kkt.append(float(jnp.max(jnp.maximum(plans.kkt, plans.violation))))
        X, U = plans.X, plans.U
    assert kkt[0] > 1e-3
    assert kkt[-1] < 1e-3 * kkt[0]
    np.testing.assert_allclose(U, best.U, atol=1e-5)


def test_new_numbers_never_mean_a_new_program():
    traces = 0

    @eqx.filter_jit
    def counted(args, options):
        nonlocal traces
        traces += 1
        x0, before, p, X, U = args
        return solve_batch(Pendulum(), x0, before, p, X, U, options)

    x0, before, p, X, U = problem()
    counted((x0, before, p, X, U), Options(1e-6))
    counted((x0 + 0.1, before, p * 0.5, X, U), Options(1e-7, 0.1, 30))
    assert traces == 1
    assert jax.tree.leaves(counted((x0, before, p, X, U), Options(1e-6)).result)
