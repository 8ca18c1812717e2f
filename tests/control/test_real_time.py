"""The drift MPC in two halves at a fixed rate: the real-time iteration of the solver, one program, no growth."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import driftjax.control.drift_mpc as module
from driftjax.control.drift_mpc import DriftMPC, MPCState, mpc_state, steady_reference
from driftjax.control.mpc import MPCConfig
from driftjax.control.mpc_solution import prepare_mpc, respond_mpc
from driftjax.core import Control, State, rk4_step
from driftjax.studies.bench.drift import U_REF, X_REF, car

N = MPCConfig().horizon
REFERENCE = steady_reference(X_REF[0], X_REF[1], X_REF[2], N)
GUESS = np.tile(U_REF, (N, 1))
DRIFT = jnp.array([*X_REF, 0.0, -X_REF[1]])
OFF = DRIFT + jnp.array([0.3, 0.05, -0.05, 0.0, 0.0])
MPC = eqx.tree_at(
    lambda m: (m.options.tolerance, m.options.max_steps), DriftMPC(car()), (jnp.asarray(1e-8, float), jnp.asarray(1))
)


def test_the_response_at_the_expected_state_is_the_real_time_iteration():
    state = mpc_state(OFF, U_REF)
    whole = MPC.solve(state, REFERENCE, GUESS)
    prepared = MPC.prepare(state, REFERENCE, GUESS)
    answer = MPC.respond(prepared, state)
    np.testing.assert_allclose(answer.U, whole.U, rtol=1e-9)
    np.testing.assert_allclose(answer.X, whole.X, rtol=1e-9, atol=1e-12)
    assert float(answer.response.error[0]) <= 1e-8
    error = MPC.judge(prepared, answer)
    np.testing.assert_allclose([error.kkt[0], error.violation[0]], [whole.plan.kkt, whole.plan.violation], rtol=1e-6)


def test_the_response_to_another_state_differs_in_the_second_order_of_the_distance():
    apart = []
    for distance in (4e-2, 2e-2, 1e-2):
        measured = mpc_state(DRIFT + distance * jnp.array([1.0, 0.2, -0.2, 0.0, 0.0]), U_REF)
        prepared = MPC.prepare(mpc_state(DRIFT, U_REF), REFERENCE, GUESS)
        answer, whole = MPC.respond(prepared, measured), MPC.solve(measured, REFERENCE, GUESS)
        apart.append(abs(float(answer.u.delta - whole.u.delta)))
    assert apart[0] / apart[1] == pytest.approx(4, rel=0.3)
    assert apart[1] / apart[2] == pytest.approx(4, rel=0.3)


def test_states_side_by_side_get_what_each_gets_alone():
    states = MPCState(*(jnp.stack(pair) for pair in zip(mpc_state(DRIFT, U_REF), mpc_state(OFF, U_REF), strict=True)))
    both = MPC.respond(MPC.prepare(states, REFERENCE, GUESS), states)
    for i, x in enumerate((DRIFT, OFF)):
        alone = MPC.respond(MPC.prepare(mpc_state(x, U_REF), REFERENCE, GUESS), mpc_state(x, U_REF))
        np.testing.assert_allclose(both.U[i], alone.U, rtol=1e-9)


def driven(num_steps: int) -> tuple[np.ndarray, int, list[int]]:
    """Drive the nominal car; its motion, how often the halves were traced, and how many arrays live after each step."""
    traced, alive, motion = [], [], []
    nominal = car().build()
    # the car turns along a circle, so that offset and heading error stay as they are
    plant = jax.jit(lambda x, u: jnp.stack(rk4_step(lambda y: list(nominal(State(*y), u)), list(x), 0.05)))
    jax.clear_caches()  # else what another test has traced is not traced again
    counted = lambda half: lambda *args: (traced.append(1), half(*args))[1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "prepare_mpc", counted(prepare_mpc))
        patch.setattr(module, "respond_mpc", counted(respond_mpc))
        mpc = DriftMPC(car())
        x, command, answer = OFF, jnp.asarray(U_REF), mpc.solve(mpc_state(OFF, U_REF), REFERENCE, GUESS)
        for _ in range(num_steps):
            expected = MPCState(answer.X[1], command, command)
            prepared = mpc.prepare(expected, REFERENCE, answer)
            answer = mpc.respond(prepared, MPCState(x, command, command))
            command = jnp.stack([answer.u.delta, answer.u.Fxr])
            x = jnp.concatenate([plant(x[:3], Control(*command)), DRIFT[3:]])
            motion.append(np.array(x[:3]))  # a copy: a view would keep the array
            alive.append(len(jax.live_arrays()))
    return np.array(motion), len(traced), alive


def test_a_car_is_driven_into_the_drift_by_one_program_each():
    motion, traced, alive = driven(60)
    np.testing.assert_allclose(motion[-10:], np.tile(X_REF, (10, 1)), atol=5e-3)
    assert traced == 2
    assert max(alive[2:]) == min(alive[2:])


@pytest.mark.slow
def test_memory_stays_over_a_hundred_thousand_steps():
    _, traced, alive = driven(100_000)
    assert traced <= 2  # none where another test has compiled them
    assert alive[-1] == alive[2]
