"""Solve the drift MPC of this package on the reference drift: many solves at once, real-time iteration or converged."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.control.drift_batch_ocp import DriftBatchOCP, drift_batch_ocp
from driftjax.control.mpc import Reference
from driftjax.core import RESULTS
from driftjax.gp import GP, Hyper, condition, data_scales
from driftjax.solve import Options, solve_batch
from driftjax.studies.bench.config import Dtype
from driftjax.studies.bench.drift import HORIZON, TOLERANCE, WEIGHTS, X_REF, Starts, car, config, residual_rows
from driftjax.vehicle import Residual

Kind = Literal["rti", "converged"]
BARRIER, MAX_STEPS = 1.0, 60
TOLERANCES: dict[Dtype, float] = {"float64": TOLERANCE, "float32": 1e-3}  # scaled KKT residual


class Solved(NamedTuple):
    """Results of a batch of solves."""

    cost: Array  # (n,) of the plan
    solved: Array  # (n,) bool: to the tolerance; of a real-time iteration its quadratic program


@eqx.filter_jit
def _batched(kind: Kind, ocp: DriftBatchOCP, starts: tuple[Array, Array], N: int, tolerance: float) -> Solved:
    """Solve from states (3, n) and last commands (2, n); the guess is the reference with the last command held."""
    x, previous = starts
    n = x.shape[1]
    reference = Reference(*(jnp.full((N + 1, 1), value, x.dtype) for value in (*X_REF, 0.0, 0.0, 0.0)))
    X = jnp.stack([jnp.full((N + 1, n), value, x.dtype) for value in X_REF])
    U = jnp.broadcast_to(previous[:, None], (2, N, n))
    options = Options(tolerance, BARRIER, 1 if kind == "rti" else MAX_STEPS)
    plans = solve_batch(ocp, x, previous, reference, X, U, options)
    solved = plans.qp_error <= tolerance if kind == "rti" else plans.result == RESULTS.successful
    return Solved(plans.cost, solved)


def mpc_solves(
    kind: Kind, starts: Starts, dtype: Dtype, *, horizon: int = HORIZON, threads: int = 1, gp: GP | None = None
) -> Callable[[], Solved]:
    """Return the solves of all `starts` in equal parts on `threads`, with `gp` in the dynamics, ready to run."""
    residual = None if gp is None else Residual(gp, jnp.ones(3), jnp.zeros(2))
    problem = drift_batch_ocp(config(horizon), WEIGHTS, car(), residual, jnp.dtype(dtype).type)
    num = len(starts.x)
    parts = threads if num % threads == 0 else 1
    x, previous = starts.x.T, (starts.previous / [1.0, config(horizon).Fxr_unit]).T
    cut = [(jnp.asarray(x[:, i::parts], dtype), jnp.asarray(previous[:, i::parts], dtype)) for i in range(parts)]
    pool = ThreadPoolExecutor(parts)

    def run() -> Solved:
        solve = lambda part: jax.block_until_ready(_batched(kind, problem, part, horizon, TOLERANCES[dtype]))
        solved = [solve(cut[0])] if parts == 1 else list(pool.map(solve, cut))
        interleaved = lambda *sides: np.stack(sides, axis=1).reshape(num)
        return jax.tree.map(interleaved, *solved)

    return run


def example_gp(num: int) -> GP:
    """Return a GP of the rate differences of a car with less friction near the drift, on `num` random points."""
    Z, Y = (jnp.asarray(table, jnp.result_type(float)) for table in residual_rows(num))
    mask = jnp.ones(num, bool)
    hyper = Hyper(jnp.full((3, 5), jnp.log(3.0)), jnp.zeros(3), jnp.full(3, jnp.log(0.05)))
    return condition(Z, Y, mask, hyper, *data_scales(Z, Y, mask), "se")
