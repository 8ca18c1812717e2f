"""Derivatives through closed-loop laps on a short piece against central differences; a step along them helps."""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.driver import Driver
from driftjax.control.mpc import MPCConfig, Weights, drift_ocp
from driftjax.control.pursuit import PursuitConfig, pure_pursuit
from driftjax.control.table import ReferenceTable
from driftjax.gp import zero_gp
from driftjax.sim import LapConfig, drive
from driftjax.sim.sensors import SensorConfig
from driftjax.solve import Options
from driftjax.track.build import from_curvature
from driftjax.tune.blend import blended
from driftjax.tune.config import Scales
from driftjax.tune.loss import lap_errors, lap_loss
from driftjax.tune.parameters import NAMES, scaled_drivers
from driftjax.vehicle import load_plant, load_vehicle, no_residual, stack_plants

SCALES, WIDTH, DT = Scales(), 3.0, 0.05
LAP = LapConfig(time_limit=1.2, substeps=15)
SENSORS = SensorConfig(sigma_beta=0.002, sigma_r=0.002)


@cache
def batch():
    """The sedan at 10 m/s, a metre beside a bend that begins where the MPC has just taken over."""
    car = load_vehicle("sedan").with_combined_slip(1.0)
    path = from_curvature([0.0, 5.0, 8.0, 40.0], [0.0, 0.0, 0.06, 0.06], 4.0, 161)
    num = 41
    s = jnp.linspace(0.0, 40.0, num)
    kappa = jax.vmap(lambda one: path.pose(one)[3])(s)
    flat = jnp.zeros(num)
    table = ReferenceTable(
        0.0, 1.0, flat + 10.0, kappa, flat + 10.0, flat - 0.05, 10.0 * kappa, flat, flat + 0.05, flat, flat,
        drift_start=5.0, drift_end=12.0,
    )  # fmt: skip
    weights = Weights((5.0, 200.0, 20.0), (30.0, 200.0), 1000.0)
    ocp = drift_ocp(MPCConfig(horizon=8, max_steps=60), weights, car, no_residual(zero_gp(1, 5, 3)))
    driver = Driver("mpc", path, table, pure_pursuit(PursuitConfig(), car), None, ocp, Options(1e-8, 1.0, 60),
                    lead=2.7, trail=30.0, handover_beta=0.15, estimator=None, dither=jnp.zeros(2))  # fmt: skip
    batched = jax.tree.map(lambda a: jnp.asarray(a)[None] if eqx.is_array(a) else a, driver)
    return batched, stack_plants([load_plant("sedan")]), jnp.array([10.0]), jax.random.key(0)[None]


@eqx.filter_jit
def value(p, width):
    """Sum of squares of the piece driven; it is not a whole lap, so nothing here asks for its end."""
    drivers, plants, speed, keys = batch()
    now = scaled_drivers(drivers, p)
    memory = eqx.filter_vmap(lambda d: d.start())(now)
    policy = lambda sensed, memory, alive: blended(now, sensed, memory, alive, width)
    laps = drive(plants, now.path, speed, policy, memory, SENSORS, LAP, dt=DT, keys=keys)
    errors = jax.vmap(lambda t, table: lap_errors(t, table, SCALES))(laps.trace, now.table)
    return jnp.sum(errors**2), laps.trace.decision.drifting


slope = eqx.filter_jit(jax.jacfwd(value, has_aux=True))


@pytest.mark.slow
def test_slopes_through_the_loop_equal_central_differences_and_a_step_along_them_lowers_the_loss():
    width, zero = jnp.asarray(WIDTH), jnp.zeros(len(NAMES))
    gradient, drifting = slope(zero, width)
    assert int(jnp.sum(drifting)) >= 8
    h = 1e-4
    apart = np.array([float(value(h * e, width)[0] - value(-h * e, width)[0]) / (2 * h) for e in np.eye(len(NAMES))])
    np.testing.assert_allclose(gradient, apart, rtol=1e-4, atol=1e-6 * np.abs(apart).max())
    down, here = -gradient / jnp.linalg.norm(gradient), float(value(zero, width)[0])
    lower = here - float(value(h * down, width)[0])
    assert lower == pytest.approx(h * float(jnp.linalg.norm(gradient)), rel=0.02)
    # at 1e-3 one step of the drift has another optimum, whose laps cost 0.1 % more; larger steps gain all the same
    assert float(value(1e-2 * down, width)[0]) < here


def test_a_lap_that_fails_has_the_fixed_loss():
    errors = jnp.ones((4, 3))
    assert float(lap_loss(errors, jnp.asarray(1), SCALES)) == 12.0
    assert float(lap_loss(errors, jnp.asarray(2), dataclasses.replace(SCALES, failed=7.0))) == 7.0
