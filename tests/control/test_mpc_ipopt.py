"""The drift MPC on 256 starts around the sedan's drift: converges, holds its limits, costs what IPOPT's costs."""

import dataclasses
from functools import cache

import drift_mpc_ipopt
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from driftjax.control.mpc import MPCConfig, MPCSolution, Reference, Weights, drift_ocp, solve_mpc
from driftjax.core import RESULTS
from driftjax.gp import zero_gp
from driftjax.solve import Options
from driftjax.vehicle import load_vehicle, no_residual

N, NUM = 20, 256
X_REF, U_REF = np.array([9.0, -0.54507, 1.1]), np.array([-0.29676, 6849.25])
CAR = dataclasses.replace(
    load_vehicle("sedan"), delta_max=0.6, Fxr_min=0.0, Fxr_max=1e4, delta_rate_max=2.0, Fxr_rate_max=3e4
)
CONFIG = MPCConfig(horizon=N)


@cache
def ocp():
    return drift_ocp(CONFIG, Weights(), CAR, no_residual(zero_gp(4, 5, 3)))


def starts() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    x = X_REF + 0.3 * rng.uniform(-1, 1, (NUM, 3)) * np.array([1.0, 0.15, 0.25])
    return x, U_REF + 0.3 * rng.uniform(-1, 1, (NUM, 2)) * np.array([0.08, 1000.0])


@cache
def solved() -> MPCSolution:
    x, before = starts()
    x = jnp.concatenate([jnp.asarray(x), jnp.zeros((NUM, 2))], axis=1)
    reference = Reference(*(jnp.full(N + 1, value) for value in (*X_REF, 0.0, 0.0, 0.0)))
    X = jnp.tile(jnp.array([*X_REF, 0.0, 0.0]), (N + 1, 1))

    def one(x, before):
        options = Options(1e-6, 1.0, 60)
        return solve_mpc(ocp(), x, before, before, reference, X, jnp.tile(before, (N, 1)), options)

    return eqx.filter_jit(jax.vmap(one))(x, jnp.asarray(before))


def test_every_start_converges_in_few_iterations():
    plan = solved().plan
    assert bool(jnp.all(plan.result == RESULTS.successful))
    assert float(jnp.max(jnp.maximum(plan.kkt, plan.violation))) <= 1e-6
    assert int(jnp.median(plan.num_steps)) <= 15
    assert int(jnp.max(plan.num_steps)) <= 30


def test_input_and_rate_limits_hold_to_rounding():
    U = np.asarray(solved().U)
    before = np.concatenate([starts()[1][:, None], U[:, :-1]], axis=1)
    scale = np.array([1.0, 1e4])  # newtons have 1e4 times the rounding of radians
    assert np.all((U - [CAR.delta_max, CAR.Fxr_max]) / scale <= 1e-12)
    assert np.all(([-CAR.delta_max, CAR.Fxr_min] - U) / scale <= 1e-12)
    rate = CONFIG.dt * np.array([CAR.delta_rate_max, CAR.Fxr_rate_max])
    assert np.all((np.abs(U - before) - rate) / scale <= 1e-12)
    assert np.any(np.abs(U - before) > 0.99 * rate)  # else the limits would not have been tested


def test_ipopt_finds_the_same_cost():
    run = drift_mpc_ipopt.solver(CAR, CONFIG, Weights(), X_REF)
    found = [run(x, before) for x, before in zip(starts()[0], starts()[1] / [1.0, 1000.0], strict=True)]
    assert all(success for _, success in found)
    ours, theirs = np.asarray(solved().plan.cost), np.array([cost for cost, _ in found])
    assert np.mean(np.abs(ours - theirs) <= 1e-3 * theirs) >= 0.99
