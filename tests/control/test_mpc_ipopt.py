"""The drift MPC on 32 starts around the sedan's drift: converges, holds its limits, costs what IPOPT's costs."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from driftjax.control.mpc import MPCSolution, Reference, drift_ocp, solve_mpc
from driftjax.core import RESULTS
from driftjax.gp import zero_gp
from driftjax.solve import Options
from driftjax.studies.bench.casadi_mpc import CasadiMPC
from driftjax.studies.bench.drift import WEIGHTS, X_REF, car, config, starts
from driftjax.vehicle import no_residual

NUM = 32
N = config().horizon


@cache
def ocp():
    return drift_ocp(config(), WEIGHTS, car(), no_residual(zero_gp(4, 5, 3)))


@cache
def solved() -> MPCSolution:
    x, before = starts(NUM)
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
    v = car()
    before = np.concatenate([starts(NUM).previous[:, None], U[:, :-1]], axis=1)
    scale = np.array([1.0, 1e4])  # newtons have 1e4 times the rounding of radians
    assert np.all((U - [v.delta_max, v.Fxr_max]) / scale <= 1e-12)
    assert np.all(([-v.delta_max, v.Fxr_min] - U) / scale <= 1e-12)
    rate = config().dt * np.array([v.delta_rate_max, v.Fxr_rate_max])
    assert np.all((np.abs(U - before) - rate) / scale <= 1e-12)
    assert np.any(np.abs(U - before) > 0.99 * rate)  # else the limits would not have been tested


def test_ipopt_finds_the_same_cost():
    peer = CasadiMPC("ipopt", car(), config(), WEIGHTS, X_REF, 1e-8, compiled=False)
    found = [peer.solve(x, before) for x, before in zip(*starts(NUM), strict=True)]
    assert all(one.success for one in found)
    ours, theirs = np.asarray(solved().plan.cost), np.array([one.cost for one in found])
    assert np.mean(np.abs(ours - theirs) <= 1e-3 * theirs) >= 0.99
