"""The drift MPC as one object: one program for batch, guess and warm start; limits and costs against IPOPT's."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import driftjax.control.drift_mpc as module
from driftjax.control.drift_mpc import DriftMPC, mpc_state, steady_reference
from driftjax.control.mpc import MPCConfig, Reference
from driftjax.control.mpc_solution import MPCSolution, solve_mpc_batch
from driftjax.core import RESULTS
from driftjax.studies.bench.casadi_mpc import CasadiMPC
from driftjax.studies.bench.drift import U_REF, WEIGHTS, X_REF, car, config, starts

# horizon and batch of experiments/examples/mpc.py, whose programs these are
N, BATCH = MPCConfig().horizon, 4
REFERENCE = steady_reference(X_REF[0], X_REF[1], X_REF[2], N)
GUESS = np.tile(U_REF, (N, 1))
START = jnp.array([*X_REF, 0.0, -X_REF[1]])


def tight(tolerance: float) -> DriftMPC:
    """The MPC with another tolerance, a number of the same program."""
    return eqx.tree_at(lambda m: m.options.tolerance, DriftMPC(car()), jnp.asarray(tolerance, float))


@pytest.fixture(scope="module")
def solutions():
    """A batch from a guess, its warm start, and from the last command; how often the solver was traced."""
    traced = []
    states = mpc_state(START + np.random.default_rng(0).normal(0, 0.01, (BATCH, 5)), U_REF)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "solve_mpc_batch", lambda *args: (traced.append(1), solve_mpc_batch(*args))[1])
        mpc = tight(1e-6)
        first = mpc.solve(states, REFERENCE, GUESS)
        warm = mpc.solve(states, REFERENCE, first)
        held = mpc.solve(states, REFERENCE)
        mpc.solve(states, jax.tree.map(lambda a: jnp.full(N + 1, float(a[0])), REFERENCE), GUESS)  # weakly typed
        each = mpc.solve(states, REFERENCE, jnp.tile(jnp.asarray(GUESS), (BATCH, 1, 1)))
    return states, first, warm, held, each, len(traced)


def test_every_kind_of_start_is_solved_by_one_program(solutions):
    assert solutions[-1] == 1


def test_all_starts_end_in_the_same_optimum(solutions):
    _, first, *others, _ = solutions
    assert np.all(first.plan.result == RESULTS.successful)
    for other in others:
        assert np.all(other.plan.result == RESULTS.successful)
        np.testing.assert_allclose(other.U, first.U, rtol=1e-5, atol=1e-5)


def test_a_guess_for_each_problem_is_the_shared_one(solutions):
    _, first, _, _, each, _ = solutions
    for one, other in zip(jax.tree.leaves(first.plan), jax.tree.leaves(each.plan), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_warm_start_takes_fewer_iterations(solutions):
    _, first, warm, *_ = solutions
    assert np.all(warm.plan.num_steps < first.plan.num_steps)


@pytest.mark.slow
def test_the_derivative_by_the_state_equals_central_differences(h=1e-5):
    mpc = tight(1e-9)
    slope = jax.jacfwd(lambda x: mpc.solve(mpc_state(x, U_REF), REFERENCE, GUESS).u.delta)(START)
    beside = np.asarray(START) + h * np.concatenate([np.eye(5), -np.eye(5), np.zeros((2, 5))])
    solutions = [mpc.solve(mpc_state(x, U_REF), REFERENCE, GUESS) for x in np.split(beside, len(beside) // BATCH)]
    assert all(np.all(one.plan.result == RESULTS.successful) for one in solutions)
    delta = np.concatenate([one.u.delta for one in solutions])
    np.testing.assert_allclose(slope, (delta[:5] - delta[5:10]) / (2 * h), rtol=1e-4, atol=1e-6)


NUM = 32  # starts around the drift of the bench


@cache
def solved() -> MPCSolution:
    """The bench's problem from all starts, in batches that the program of this file takes."""
    mpc = DriftMPC(car(), config(N), WEIGHTS)
    x, before = starts(NUM)
    states = mpc_state(np.concatenate([x, np.zeros((NUM, 2))], axis=1), before)
    reference = Reference(*(jnp.full(N + 1, value) for value in (*X_REF, 0.0, 0.0, 0.0)))
    guess = jnp.tile(jnp.asarray(before)[:, None], (1, N, 1))
    block = lambda tree, i: jax.tree.map(lambda a: a[i : i + BATCH], tree)
    solutions = [mpc.solve(block(states, i), reference, block(guess, i)) for i in range(0, NUM, BATCH)]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *solutions)


def test_every_start_converges_in_few_iterations():
    plan = solved().plan
    assert bool(jnp.all(plan.result == RESULTS.successful))
    assert float(jnp.max(jnp.maximum(plan.kkt, plan.violation))) <= 1e-6
    assert int(jnp.median(plan.num_steps)) <= 15
    assert int(jnp.max(plan.num_steps)) <= 30


def test_input_and_rate_limits_hold_to_rounding():
    U = np.asarray(solved().U)
    v = car()
    before = np.concatenate([starts(NUM).previous[:, None], U[:, :-1]], axis=1)
    scale = np.array([1.0, 1e4])  # newtons have 1e4 times the rounding of radians
    assert np.all((U - [v.delta_max, v.Fxr_max]) / scale <= 1e-12)
    assert np.all(([-v.delta_max, v.Fxr_min] - U) / scale <= 1e-12)
    rate = config().dt * np.array([v.delta_rate_max, v.Fxr_rate_max])
    assert np.all((np.abs(U - before) - rate) / scale <= 1e-12)
    assert np.any(np.abs(U - before) > 0.99 * rate)  # else the limits would not have been tested


def test_ipopt_finds_the_same_cost():
    peer = CasadiMPC("ipopt", car(), config(N), WEIGHTS, X_REF, 1e-8, compiled=False)
    peer_solutions = [peer.solve(x, before) for x, before in zip(*starts(NUM), strict=True)]
    assert all(one.success for one in peer_solutions)
    ours, theirs = np.asarray(solved().plan.cost), np.array([one.cost for one in peer_solutions])
    assert np.mean(np.abs(ours - theirs) <= 1e-3 * theirs) >= 0.99
