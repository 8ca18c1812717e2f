"""When the drift controller takes over and gives back, and what is driven where its solve fails."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.dither import corner_excitation
from driftjax.control.driver import Driver, DriverState, decide
from driftjax.control.lqr import ScheduledLQR
from driftjax.control.mpc import MPCConfig, Weights, drift_ocp
from driftjax.control.mpc_solution import solve_mpc
from driftjax.control.pursuit import PursuitConfig, pure_pursuit
from driftjax.control.table import ReferenceTable
from driftjax.gp import zero_gp
from driftjax.sim import Sensed
from driftjax.solve import Options
from driftjax.track.build import from_curvature
from driftjax.vehicle import load_vehicle, no_residual

CAR = load_vehicle("sedan")


def driver(kind) -> Driver:
    path = from_curvature([0.0, 100.0], [0.0, 0.0], 4.0, 101)
    columns = [jnp.asarray(np.full(11, value)) for value in (10.0, 0.0, 9.0, -0.5, 1.0, 0.0, 0.5, -0.3, 6000.0)]
    table = ReferenceTable(0.0, 10.0, *columns, drift_start=40.0, drift_end=60.0)
    ocp = drift_ocp(MPCConfig(horizon=3), Weights(), CAR, no_residual(zero_gp(4, 5, 3)))
    gains = ScheduledLQR(jnp.array([30.0, 70.0]), jnp.zeros((2, 2, 9)))
    return Driver(kind, path, table, pure_pursuit(PursuitConfig(), CAR), gains, ocp, Options(),
                  lead=6.0, trail=4.0, handover_beta=0.15, estimator=None, dither=jnp.zeros(2))  # fmt: skip


def engaged(kind, s: float, beta: float, drifting: bool) -> bool:
    one = driver(kind)
    zero = jnp.asarray(0.0)
    sensed = Sensed(jnp.asarray(9.0), jnp.asarray(beta), zero, jnp.asarray(s), zero, zero, jnp.asarray(s), zero, zero)
    memory: DriverState = one.start()._replace(drifting=jnp.asarray(drifting))
    return bool(_engaged(one, sensed, memory))


_engaged, pursue, stabilise, mpc_problem = (
    eqx.filter_jit(lambda one, *now, of=of: getattr(one, of)(*now))
    for of in ("engaged", "pursue", "stabilise", "mpc_problem")
)


@pytest.mark.parametrize(
    "s, beta, drifting, expected",
    [
        (33.9, 0.0, False, False),  # before section less lead
        (34.1, 0.0, False, True),
        (63.9, 0.0, True, True),  # within trail
        (64.1, 0.1, True, False),  # straight again
        (64.1, -0.3, True, True),  # still sliding
        (64.1, -0.3, False, False),  # sliding, but not by the drift controller
        (72.1, -0.3, True, False),  # three times trail is the end
    ],
)
def test_the_switch_rule(s, beta, drifting, expected):
    assert engaged("mpc", s, beta, drifting) is expected


def test_the_pursuit_driver_never_drifts():
    assert not engaged("pursuit", 50.0, -0.4, True)


def test_commands_of_every_kind_hold_the_limits():
    one = driver("lqr")
    zero = jnp.asarray(0.0)
    sensed = Sensed(jnp.asarray(2.0), zero, zero, jnp.asarray(50.0), jnp.asarray(-3.0), zero, jnp.asarray(50.0), zero,
                    zero)  # fmt: skip
    memory = one.start()
    rate = np.asarray(one.ocp.rate)
    pursued, stabilised = (np.asarray(by(one, sensed, memory)) for by in (pursue, stabilise))
    for u in (pursued, stabilised):
        assert np.all(np.abs(u) <= rate * (1 + 1e-12))
    # far off both targets, so each goes as far as one step allows
    assert pursued[0] == pytest.approx(rate[0])
    assert stabilised[0] == pytest.approx(-rate[0])


def sliding(s: float) -> Sensed:
    zero, half = jnp.asarray(0.0), jnp.asarray(-0.5)
    return Sensed(jnp.asarray(9.0), half, jnp.asarray(1.0), jnp.asarray(s), zero, -half, jnp.asarray(s), zero, -half)


@eqx.filter_jit
def step(one, sensed, memory):
    """One step of the drift MPC, alone."""
    problem = one.mpc_problem(sensed, memory)
    return one.apply_solution(problem, solve_mpc(one.ocp, *problem), sensed, memory)


def test_where_a_solve_fails_the_last_good_plan_is_driven_one_step_later():
    one = driver("mpc")
    start = one.start()._replace(command=jnp.asarray([-0.29, 6000.0]))
    first, memory = step(one, sliding(50.0), start)
    assert bool(first.solved) and bool(memory.drifting)
    allowed_none = eqx.tree_at(lambda d: d.options.max_steps, one, jnp.asarray(0))
    second, after = step(allowed_none, sliding(50.5), memory)
    assert not bool(second.solved)
    good = np.asarray(memory.good)
    np.testing.assert_allclose(np.stack(second.command), good[0], rtol=1e-12)
    np.testing.assert_allclose(np.asarray(after.good)[0], good[1], rtol=1e-12)


def test_a_solve_starts_from_the_reference_whatever_was_driven_before():
    one = driver("mpc")
    start = one.start()._replace(command=jnp.asarray([-0.29, 6000.0]))
    memory = start._replace(good=jnp.asarray(np.full((3, 2), 0.6)), drifting=jnp.asarray(True))
    problem = jax.device_get(mpc_problem(one, sliding(50.0), memory))
    np.testing.assert_allclose(problem.X[1:], np.tile([9.0, -0.5, 1.0, 0.0, 0.5], (3, 1)), rtol=1e-12)
    np.testing.assert_allclose(problem.U, np.tile([-0.3, 6000.0], (3, 1)), rtol=1e-12)
    np.testing.assert_allclose(problem.X[0], [9.0, -0.5, 1.0, 0.0, 0.5], rtol=1e-12)


@pytest.mark.slow
def test_each_entry_is_driven_by_its_own_controller_and_the_others_do_not_matter():
    one = driver("mpc")
    stack = lambda *trees: jax.tree.map(lambda *a: jnp.asarray(np.stack(a)) if eqx.is_array(a[0]) else a[0], *trees)
    start = one.start()._replace(command=jnp.asarray([-0.29, 6000.0]))
    sensed = stack(sliding(10.0), sliding(50.0), sliding(50.0))
    alive = jnp.asarray([True, True, False])
    command, memory, decision = eqx.filter_jit(decide)(stack(one, one, one), sensed, stack(start, start, start), alive)
    assert decision.drifting.tolist() == [False, True, False] and int(decision.num_steps[0]) == 0
    alone, _ = step(one, sliding(50.0), start)
    np.testing.assert_allclose(command.delta[1], alone.command.delta, rtol=1e-6)
    np.testing.assert_allclose(np.stack(command)[:, 0], pursue(one, sliding(10.0), start), rtol=1e-9)
    assert memory.drifting.tolist() == [False, True, False]


def test_the_excitation_is_added_within_the_corner_and_within_the_limits():
    one = driver("mpc")
    sensed, start = sliding(45.0), one.start()._replace(command=jnp.asarray([-0.29, 6000.0]))
    excited, large = (
        eqx.tree_at(lambda d: d.dither, one, jnp.array(amplitude)) for amplitude in ((0.004, 100.0), (1.0, 1e5))
    )
    still, moved, far = (np.stack(step(each, sensed, start)[0].command) for each in (one, excited, large))
    share = (45.0 - (40.0 - 6.0)) / (60.0 - (40.0 - 6.0))
    expected = np.array([0.004, 100.0]) * np.asarray(corner_excitation(jnp.asarray(share)))
    rate, before = np.asarray(one.ocp.rate), np.asarray(start.command)
    np.testing.assert_allclose(moved, np.clip(still + expected, before - rate, before + rate), rtol=1e-9)
    assert np.any(moved != still) and np.all(np.abs(far - before) <= rate * (1 + 1e-12))
    np.testing.assert_array_equal(step(excited, sensed, start)[1].command, moved)  # the next step starts from it
    np.testing.assert_array_equal(excited.excitation(jnp.asarray(70.0)), 0.0)
