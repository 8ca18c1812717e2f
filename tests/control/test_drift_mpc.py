"""The drift MPC as one object: a batch, a guess and a warm start are solved by one program."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import driftjax.control.drift_mpc as module
from driftjax.control.drift_mpc import DriftMPC, mpc_state, steady_reference
from driftjax.control.mpc import MPCConfig, solve_mpc
from driftjax.core import RESULTS
from driftjax.studies.bench.drift import U_REF, X_REF, car

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
        patch.setattr(module, "solve_mpc", lambda *args: (traced.append(1), solve_mpc(*args))[1])
        mpc = tight(1e-6)
        first = mpc.solve(states, REFERENCE, GUESS)
        warm = mpc.solve(states, REFERENCE, first)
        held = mpc.solve(states, REFERENCE)
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


def test_the_derivative_by_the_state_equals_central_differences(h=1e-5):
    mpc = tight(1e-9)
    slope = jax.jacfwd(lambda x: mpc.solve(mpc_state(x, U_REF), REFERENCE, GUESS).u.delta)(START)
    beside = np.asarray(START) + h * np.concatenate([np.eye(5), -np.eye(5), np.zeros((2, 5))])
    solutions = [mpc.solve(mpc_state(x, U_REF), REFERENCE, GUESS) for x in np.split(beside, len(beside) // BATCH)]
    assert all(np.all(one.plan.result == RESULTS.successful) for one in solutions)
    delta = np.concatenate([one.u.delta for one in solutions])
    np.testing.assert_allclose(slope, (delta[:5] - delta[5:10]) / (2 * h), rtol=1e-4, atol=1e-6)
