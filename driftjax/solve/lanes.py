"""Optimal control problems in batches: a primal-dual interior point with the batch on the last axis.

Every iteration linearises the dynamics anew with second derivatives of the Lagrangian, solves the barrier problem's
Newton system by one Riccati sweep and goes to the boundary by a fraction. There is no line search: nearly all lanes of
a tracking problem converge from a fair guess in ten to twenty iterations, the others say so in `result`, and the
safeguarded `solve` takes them. Everything is elementwise along the batch, so that a CPU fills its vector registers with
lanes. Sources: Waechter and Biegler 2006 (barrier, fraction to the boundary, error scaling, Eq. 16: duals kept near the
barrier).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, PyTree

from driftjax.core import RESULTS
from driftjax.solve.interior_point import SLACK_FLOOR, split
from driftjax.solve.lane_newton import (
    Error,
    Lanes,
    gaps_of,
    inputs_before,
    longest,
    measured,
    newton_step,
    newton_system,
)
from driftjax.solve.lane_ocp import AbstractLanes, Components
from driftjax.solve.materialise import materialised
from driftjax.solve.ocp import Options

MANY, SHARE = 64, 8  # of so many lanes the last eighth goes on by itself
CENTRALITY = 10.0  # factor by which a product of slack and dual may differ from the barrier


class LanePlans(eqx.Module):
    """Solutions of a batch; components on the first axis, the batch on the last."""

    X: Float[Array, "nx N+1 batch"]
    U: Float[Array, "nu N batch"]
    costates: Float[Array, "nx N batch"]
    dual: Float[Array, "ng N batch"]
    cost: Float[Array, " batch"]  # objective at (X, U)
    kkt: Float[Array, " batch"]  # scaled stationarity and complementarity [-]
    violation: Float[Array, " batch"]  # worst defect or violation of a limit
    num_steps: Array  # iterations of the slowest lane
    result: RESULTS


class _Loop(NamedTuple):
    lanes: Lanes
    barrier: Array
    error: Error
    num_steps: Array


class _Batch(NamedTuple):
    """Constant data of the iterations."""

    ocp: AbstractLanes
    stages: PyTree  # parameters (N, batch) or (N, 1)
    last: PyTree  # those of the end (batch,) or (1,)
    u_before: Components
    needed: Array  # lanes to be solved
    tolerance: Array  # of each lane
    max_steps: Array

    def of(self, lanes: Array) -> "_Batch":
        """Return the data of some batch entries."""
        num = len(self.needed)
        wide = jax.tree.map(lambda a: jnp.broadcast_to(a, (*a.shape[:-1], num)), self[1:])
        return _Batch(self.ocp.of(lanes), *_of_lanes(wide, lanes))


def _open(batch: _Batch, error: Error, num_steps: Array) -> Array:
    """Return the mask of unsolved entries; non-finite ones count as finished."""
    worst = jnp.maximum(error.kkt, error.violation)
    return batch.needed & ~(worst <= batch.tolerance) & ~jnp.isnan(worst) & (num_steps < batch.max_steps)


def _rows(tree: PyTree) -> Array:
    """Return all values of each entry in one column: one gather for all, since XLA fails on many fused gathers."""
    leaves = jax.tree.leaves(tree)
    return jnp.concatenate([a.reshape(-1, a.shape[-1]).astype(jnp.result_type(*leaves)) for a in leaves])


def _unrowed(rows: Array, tree: PyTree) -> PyTree:
    """Return columns as arrays like those of `tree`, with another batch size."""
    leaves, structure = jax.tree.flatten(tree)
    ends = np.cumsum([a[..., 0].size for a in leaves])
    parts = jnp.split(rows, ends[:-1])
    like = [p.reshape(*a.shape[:-1], -1).astype(a.dtype) for p, a in zip(parts, leaves, strict=True)]
    return jax.tree.unflatten(structure, like)


def _of_lanes(tree: PyTree, lanes: Array) -> PyTree:
    return _unrowed(_rows(tree)[:, lanes], tree)


def _solved(batch: _Batch, loop: _Loop) -> _Loop:
    """Iterate until all entries are solved; the last unsolved ones are gathered into a smaller batch."""
    num = len(batch.needed)
    few = num // SHARE if num >= MANY else 0
    still = lambda s: _open(batch, s.error, s.num_steps)
    loop = jax.lax.while_loop(lambda s: jnp.sum(still(s)) > few, lambda s: _iterate(batch, s), loop)
    if not few:
        return loop
    lanes = jnp.argsort(~still(loop))[:few]
    state = loop[:-1]
    it, barrier, error = _of_lanes(state, lanes)
    rest = _solved(batch.of(lanes), _Loop(it, barrier, error, loop.num_steps))
    it, barrier, error = _unrowed(_rows(state).at[:, lanes].set(_rows(rest[:-1])), state)
    return _Loop(it, barrier, error, rest.num_steps)


def _iterate(batch: _Batch, loop: _Loop) -> _Loop:
    it, barrier = loop.lanes, loop.barrier
    newton, error = materialised(lambda it, barrier: newton_system(*batch[:4], it, barrier))(it, barrier)
    d = materialised(lambda it, newton, barrier: newton_step(batch.ocp, it, newton, barrier))(it, newton, barrier)
    open_ = _open(batch, error, loop.num_steps)
    step, dual = longest(it.slack, d.d_slack, open_), longest(it.dual, d.d_dual, open_)
    move = lambda values, steps, length: [v + length * d for v, d in zip(values, steps, strict=True)]
    slack = move(it.slack, d.d_slack, step)
    new = Lanes(
        [x.at[1:].add(step * dx) for x, dx in zip(it.X, d.dX, strict=True)],
        move(it.U, d.dU, step),
        [c + step * (n - c) for c, n in zip(it.costates, d.costates, strict=True)],
        slack,
        [_central(z, s, barrier, open_) for z, s in zip(move(it.dual, d.d_dual, dual), slack, strict=True)],
    )
    return _Loop(new, _next_barrier(new, barrier, jnp.minimum(step, dual), batch.tolerance), error, loop.num_steps + 1)


def _central(dual: Array, slack: Array, barrier: Array, open_: Array) -> Array:
    """Return duals with slack products near the barrier: an entry at a limit without its dual cannot move."""
    return jnp.where(open_, jnp.clip(dual, barrier / (CENTRALITY * slack), CENTRALITY * barrier / slack), dual)


def _next_barrier(new: Lanes, barrier: Array, length: Array, tolerance: Array) -> Array:
    """Return the next barrier parameter: it follows the mean product of slack and dual, faster after long steps."""
    if not new.slack:
        return barrier
    products = sum(jnp.sum(s * z, axis=0) for s, z in zip(new.slack, new.dual, strict=True))
    gap = products / (len(new.slack) * new.slack[0].shape[0])
    return jnp.maximum(jnp.clip((1 - length) ** 2, 0.1, 0.8) * gap, 0.1 * tolerance)


def _start(ocp: AbstractLanes, x0: Components, u_before: Components, X: Components, U: Components, barrier) -> Lanes:
    X = [x.at[0].set(first) for x, first in zip(X, x0, strict=True)]
    change = [u - b for u, b in zip(U, inputs_before(U, u_before), strict=True)]
    slack = [jnp.maximum(g, SLACK_FLOOR) for g in measured(gaps_of(ocp), U, change, [x[1:] for x in X])]
    return Lanes(X, U, [jnp.zeros_like(x[1:]) for x in X], slack, [barrier / s for s in slack])


def _result(done: Array, finite: Array) -> RESULTS:
    failed = RESULTS.where(finite, RESULTS.not_converged, RESULTS.non_finite)  # pyright: ignore[reportArgumentType]
    return RESULTS.where(done, RESULTS.successful, failed)  # pyright: ignore[reportArgumentType]


def solve_lanes(
    ocp: AbstractLanes,
    x0: Float[Array, "nx batch"],
    u_before: Float[Array, "nu batch"],
    params: PyTree,
    X: Float[Array, "nx N+1 batch"],
    U: Float[Array, "nu N batch"],
    options: Options,
    needed: Bool[Array, " batch"] | None = None,
) -> LanePlans:
    """Solve a batch from the guess `X`, `U`; leaves of `params` are (N+1, batch) or (N+1, 1), the last row for the end.

    A lane's `result` is `successful` only where its KKT residual and violation are below the tolerance. Lanes that are
    not `needed` stay at their guess and hold up none; all options may be of each lane (batch,).
    """
    dtype = U[0].dtype
    tolerance, barrier = options.tolerance.astype(dtype), options.barrier.astype(dtype)
    stages, last = split(params)
    lanes, before = _start(ocp, list(x0), list(u_before), list(X), list(U), barrier), list(u_before)
    large = jnp.full_like(U[0][0], jnp.inf)
    loop = _Loop(lanes, jnp.full_like(large, barrier), Error(large, large), jnp.zeros((), jnp.int32))
    needed = jnp.full_like(large, True, bool) if needed is None else needed
    tolerance, max_steps = (jnp.broadcast_to(a, large.shape) for a in (tolerance, options.max_steps))
    end = _solved(_Batch(ocp, stages, last, before, needed, tolerance, max_steps), loop)
    done = jnp.maximum(end.error.kkt, end.error.violation) <= tolerance
    finite = jnp.isfinite(end.error.kkt) & jnp.isfinite(end.error.violation)
    result = jax.vmap(_result)(done, finite)
    it = end.lanes
    cost = _objective(ocp, it, inputs_before(it.U, before), stages, last)
    dual = jnp.stack(it.dual) if it.dual else jnp.zeros((0, *it.U[0].shape), dtype)
    X, U, costates = (jnp.stack(v) for v in (it.X, it.U, it.costates))
    return LanePlans(X, U, costates, dual, cost, end.error.kkt, end.error.violation, end.num_steps, result)


def _objective(ocp: AbstractLanes, it: Lanes, before: Components, stages: PyTree, last: PyTree) -> Array:
    cost = jnp.sum(ocp.cost([x[:-1] for x in it.X], it.U, stages), axis=0) + ocp.terminal([x[-1] for x in it.X], last)
    for u, b, weight in zip(it.U, before, ocp.rate_weight() or [0.0] * len(it.U), strict=True):
        cost = cost + weight * jnp.sum((u - b) ** 2, axis=0)
    return cost
