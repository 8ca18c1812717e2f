"""The drift MPC as one object: a batch, a guess and a warm start are solved by one program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import driftjax.control.drift_mpc as module
from driftjax.control.drift_mpc import DriftMPC, mpc_state, steady_reference
from driftjax.control.mpc import solve_mpc
from driftjax.core import RESULTS
from driftjax.studies.bench.drift import U_REF, X_REF, car, config

N = 8
REFERENCE = steady_reference(X_REF[0], X_REF[1], X_REF[2], N)
GUESS = np.tile(U_REF, (N, 1))


@pytest.fixture(scope="module")
def solutions():
    """A batch from a guess, its warm start, and from the last command; how often the solver was traced."""
    traced, x = [], jnp.array([*X_REF, 0.0, -X_REF[1]])
    states = mpc_state(x + np.random.default_rng(0).normal(0, 0.01, (3, 5)), U_REF)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "solve_mpc", lambda *args: (traced.append(1), solve_mpc(*args))[1])
        mpc = DriftMPC(car(), config(N))
        first = mpc.solve(states, REFERENCE, GUESS)
        warm = mpc.solve(states, REFERENCE, first)
        held = mpc.solve(states, REFERENCE)
        each = mpc.solve(states, REFERENCE, jnp.tile(jnp.asarray(GUESS), (3, 1, 1)))
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
