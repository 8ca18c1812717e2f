"""When the drift controller takes over and gives back."""

import jax.numpy as jnp
import pytest

from driftjax.control.driver import Driver, Memory
from driftjax.control.lqr import LQR
from driftjax.control.mpc import MPCConfig, Weights, drift_ocp
from driftjax.control.pursuit import PursuitConfig, pure_pursuit
from driftjax.control.table import ReferenceTable
from driftjax.gp import zero_gp
from driftjax.sim import Sensed
from driftjax.solve import Options
from driftjax.track import from_curvature
from driftjax.vehicle import load_vehicle, no_residual

CAR = load_vehicle("sedan")


def driver(kind) -> Driver:
    path = from_curvature([0.0, 100.0], [0.0, 0.0], 4.0, 101)
    columns = [jnp.full(11, value) for value in (10.0, 0.0, 9.0, -0.5, 1.0, 0.0, 0.5, -0.3, 6000.0)]
    table = ReferenceTable(0.0, 10.0, *columns, drift_start=40.0, drift_end=60.0)
    ocp = drift_ocp(MPCConfig(horizon=3), Weights(), CAR, no_residual(zero_gp(4, 5, 3)))
    return Driver(kind, path, table, pure_pursuit(PursuitConfig(), CAR), LQR(jnp.zeros((2, 3))), ocp, Options(),
                  lead=6.0, trail=4.0, handover_beta=0.15)  # fmt: skip


def engaged(kind, s: float, beta: float, drifting: bool) -> bool:
    one = driver(kind)
    zero = jnp.asarray(0.0)
    sensed = Sensed(jnp.asarray(9.0), jnp.asarray(beta), zero, jnp.asarray(s), zero, zero, jnp.asarray(s), zero, zero)
    memory: Memory = one.start(jnp.asarray(9.0))._replace(drifting=jnp.asarray(drifting))
    return bool(one.engaged(sensed, memory))


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
    memory = one.start(jnp.asarray(2.0))
    rate = one.ocp.rate
    for u in (one.pursue(sensed, memory), one.stabilise(sensed, memory)):
        assert bool(jnp.all(jnp.abs(u) <= rate * (1 + 1e-12)))
    # far off both targets, so each goes as far as one step allows
    assert float(one.pursue(sensed, memory)[0]) == pytest.approx(float(rate[0]))
    assert float(one.stabilise(sensed, memory)[0]) == pytest.approx(-float(rate[0]))
