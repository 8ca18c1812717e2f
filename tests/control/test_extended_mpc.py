"""The drift MPC and the LQR of an extended car: they converge and hold the drift that is the extended car's."""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.lqr import lqr
from driftjax.control.mpc import DriftOCP, MPCConfig, Reference, Weights, drift_ocp
from driftjax.control.mpc_solution import solve_mpc
from driftjax.core import RESULTS, Control, State, rk4_step
from driftjax.equilibrium import Branch, Equilibrium, SlipRadius, solve_steady
from driftjax.gp import zero_gp
from driftjax.solve import Options
from driftjax.vehicle import actuator_lags, build_car, load_vehicle, no_residual
from driftjax.vehicle.parameters import EffectParameterValue

FOUND = (EffectParameterValue("load_transfer_long", "h", 0.4), EffectParameterValue("steer_offset", "p", 0.02),
         EffectParameterValue("steer_lag", "tau", 0.06))  # fmt: skip
CAR = dataclasses.replace(load_vehicle("sedan"), combined_slip=1.0, effects=FOUND)
CONFIG = MPCConfig(horizon=12)


@cache
def steady() -> Equilibrium:
    fixed = SlipRadius(-0.45, 9.0)
    return eqx.filter_jit(lambda: solve_steady(build_car(CAR), fixed, branch=Branch.COUNTERSTEER))()


@cache
def ocp() -> DriftOCP:
    residual = no_residual(zero_gp(4, 5, 3), actuator_lags(CAR))
    return drift_ocp(CONFIG, Weights(front_slip=1000.0), CAR, residual)


@pytest.mark.slow  # compiles for a minute
def test_the_mpc_converges_and_ends_in_the_steady_state_of_the_extended_car():
    x, u = steady().x, steady().u
    assert steady().result == RESULTS.successful
    N, level = CONFIG.horizon, jnp.stack([*x, jnp.zeros(()), jnp.zeros(())])
    reference = Reference(*(jnp.full(N + 1, value) for value in (*x, 0.0, -x.beta, x.r / x.V)))
    level = level.at[4].set(-x.beta)
    problem, before, rng = ocp(), jnp.stack(u), np.random.default_rng(0)
    starts = level + 0.2 * rng.uniform(-1, 1, (6, 5)) * np.array([1.0, 0.15, 0.25, 0.0, 0.0])
    starts = starts.at[0].set(level)

    def one(start):
        X, U = jnp.tile(level, (N + 1, 1)), jnp.tile(before, (N, 1))
        return solve_mpc(problem, start, before, before, reference, X, U, Options(1e-5, 1.0, 60))

    solutions = eqx.filter_jit(jax.vmap(one))(starts)
    assert bool(jnp.all(solutions.plan.result == RESULTS.successful))
    assert int(jnp.max(solutions.plan.num_steps)) <= 30
    unit = jnp.array([1.0, 1e4])  # from the steady state itself there is nothing to do
    np.testing.assert_allclose(solutions.U[0] / unit, before * jnp.ones((N, 1)) / unit, atol=1e-3)


@pytest.mark.slow
def test_the_lqr_of_the_extended_car_holds_its_drift():
    car, (x, u), dt = build_car(CAR), (steady().x, steady().u), jnp.asarray(0.05)
    K = eqx.filter_jit(lqr)(car, x, u, jnp.array([1.0, 700.0, 500.0]), jnp.array([10.0, 1e-9]), dt)

    def step(y, _):
        delta, Fxr = jnp.stack(u) - K @ (y - jnp.stack(x))
        return jnp.stack(rk4_step(lambda w: car(w, Control(delta, Fxr)), State(*y), dt)), None

    start = jnp.stack(x) + jnp.array([0.05, 0.01, -0.01])
    end = jax.jit(lambda y: jax.lax.scan(step, y, length=200)[0])(start)
    np.testing.assert_allclose(end, jnp.stack(x), atol=1e-4)
