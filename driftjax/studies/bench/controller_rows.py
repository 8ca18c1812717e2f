"""Measure the drift MPC at a fixed rate: how long its two halves take, as medians and as worst of many steps."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.control.drift_mpc import DriftMPC, MPCState, steady_reference
from driftjax.control.mpc_solution import MPCResponse
from driftjax.core import Control, State, rk4_step
from driftjax.studies.bench.config import BenchConfig
from driftjax.studies.bench.drift import U_REF, WEIGHTS, X_REF, car, config, starts
from driftjax.studies.bench.mpc import example_gp
from driftjax.studies.bench.rows import PartResult, Row, Timing
from driftjax.vehicle import Residual

STEPS, QUICK_STEPS = 20_000, 200
WARM_UP = 10  # steps before, of which the first ones compile
LATEST = 5e-3  # seconds that a response may take in 99.9 % of steps
POINTS = 200  # of the Gaussian process


def measure_rows(cfg: BenchConfig) -> PartResult:
    """Drive the nominal car with the MPC, with and without a Gaussian process in its dynamics."""
    num = QUICK_STEPS if cfg.quick else STEPS
    plain = _rows("", DriftMPC(car(), config(), WEIGHTS), num)
    residual = Residual(example_gp(POINTS), jnp.ones(3), jnp.zeros(2))
    learnt = _rows(f", {POINTS}-point GP", DriftMPC(car(), config(), WEIGHTS, residual), num)
    return PartResult([*plain, *learnt])


def _rows(what: str, mpc: DriftMPC, num: int) -> list[Row]:
    prepare, respond, unsolved = _drive(mpc, num)
    rows = []
    for half, seconds, target in (("prepare", prepare, None), ("respond", respond, LATEST)):
        median, *late = np.quantile(seconds, (0.5, 0.99, 0.999))
        words = f"median {1e3 * median:.2f} ms, 99 % in {1e3 * late[0]:.2f} ms, 99.9 % in {1e3 * late[1]:.2f} ms"
        facts = {"steps": num, "median": median, "percentile_99": late[0], "percentile_99.9": late[1],
                 "unsolved": unsolved, "remarks": words}  # fmt: skip
        label = f"drift MPC at a fixed rate{what}: {half}, 99.9 % of steps"
        timing = Timing((float(late[1]),))
        rows.append(Row("controller", label, "step", timing, "", sense="seconds", target=target, facts=facts))
    return rows


def _drive(mpc: DriftMPC, num: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Drive around the drift, pushed to a random start every second; seconds of both halves, share unsolved."""
    nominal, reference = mpc.ocp.nominal, steady_reference(X_REF[0], X_REF[1], X_REF[2], mpc.horizon)
    dt, pushed = float(mpc.ocp.dt), starts(256).x
    every = round(1 / dt)

    @eqx.filter_jit
    def move(x: Array, answer: MPCResponse) -> MPCState:
        rates = lambda y: list(nominal(State(*y), Control(answer.u.delta, answer.u.Fxr)))
        moved = jnp.stack(rk4_step(rates, list(x[:3]), dt))
        command = jnp.stack([answer.u.delta, answer.u.Fxr])
        return MPCState(jnp.concatenate([moved, x[3:]]), command, command)

    command = jnp.asarray(U_REF)
    state = MPCState(jnp.array([*X_REF, 0.0, -X_REF[1]]), command, command)
    answer, times, bad = np.tile(U_REF, (mpc.horizon, 1)), np.empty((2, num)), 0
    for k in range(-WARM_UP, num):
        if k % every == 0:
            state = state._replace(x=state.x.at[:3].set(pushed[k // every % len(pushed)]))
        begin = time.perf_counter()
        prepared = jax.block_until_ready(mpc.prepare(state, reference, answer))
        middle = time.perf_counter()
        answer = jax.block_until_ready(mpc.respond(prepared, state))
        times[:, k] = middle - begin, time.perf_counter() - middle
        bad += k >= 0 and not float(answer.response.error[0]) <= float(mpc.options.tolerance)
        state = move(state.x, answer)
    return times[0], times[1], bad / num
