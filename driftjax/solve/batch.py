"""Solve optimal control problems in batches: sequential quadratic programming with the batch on the last axis.

Each iteration linearises the dynamics once, into stored matrices, with second derivatives of the Lagrangian, and makes
a few interior-point iterations on the quadratic program, which touch the matrices only (`batch_qp`); primal and dual
variables, slacks and barrier go on from one program to the next. One iteration is the real-time iteration (Diehl et
al. 2005), whose program is solved to the tolerance. Full steps are taken at first: with exact second derivatives
tracking problems converge, from far guesses too, and a line search would reject good steps of a Gaussian process's
dynamics. An entry that fails may be solved again, with a smaller barrier and a line search (`batch_search`): each
iteration either steps or halves the last step, so that no entry waits for another.
Everything is elementwise along the batch, so that a CPU fills its vector registers with batch entries.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, PyTree

from driftjax.core import RESULTS
from driftjax.solve.batch_conditions import BatchIterate, OptimalityError, QPModel
from driftjax.solve.batch_ocp import AbstractBatchOCP
from driftjax.solve.batch_program import (
    LAST_STEPS,
    BatchData,
    Programs,
    batch_data,
    first_iterate,
    qp_model,
    solve_programs,
    where,
    with_curvature,
    worst,
)
from driftjax.solve.batch_search import HALVINGS, LineSearch, accepted, no_search, search_from, trial_point
from driftjax.solve.component_derivatives import Matrix
from driftjax.solve.compute_once import compute_once
from driftjax.solve.ocp import Options, Solution
from driftjax.solve.solution_derivative import solution_tangent, split, total_cost

MANY, SHARE = 64, 8  # from this batch size on, the last eighth of the entries goes on in a smaller batch
PROGRAM_STEPS = 3  # interior-point iterations per program, but for the last one allowed
EARLY = 8  # iterations of a batch of `MANY` with cheaper second derivatives: most entries need no more
SMALLER = 0.1  # times the first barrier of the attempt before
FORCING, COARSE, FINE = 0.1, 1e-2, 0.3  # a program ends at these shares of the problem's error, of 1, of the tolerance


class BatchSolution(eqx.Module):
    """Solutions of a batch; components on the first axis, the batch on the last."""

    X: Float[Array, "nx N+1 batch"]
    U: Float[Array, "nu N batch"]
    cost: Float[Array, " batch"]  # objective at (X, U)
    kkt: Float[Array, " batch"]  # scaled stationarity and complementarity of the problem, not of a program [-]
    violation: Float[Array, " batch"]  # worst defect or violation of a limit
    qp_error: Float[Array, " batch"]  # worst of both, of the last quadratic program
    num_steps: Array  # SQP iterations (batch,)
    qp_steps: Array  # interior-point iterations in all of them (batch,)
    result: RESULTS


def plain(plans: BatchSolution) -> Solution:
    """Return the solutions in plain shapes, the batch on the first axis."""
    first = lambda a: jnp.moveaxis(a, -1, 0)
    X, U = (jnp.swapaxes(first(a), 1, 2) for a in (plans.X, plans.U))
    return Solution(X, U, plans.cost, plans.kkt, plans.violation, plans.num_steps, plans.result)


class _Loop(NamedTuple):
    iterate: BatchIterate
    search: LineSearch
    barrier: Array
    error: OptimalityError  # of the problem
    qp_error: Array  # error of the last program
    num_steps: Array
    qp_steps: Array
    infeasible: Array  # whether the last program was proven to have no feasible point
    open: Array  # whether the iterate is still to be judged


def _pack(tree: PyTree) -> Array:
    """Return all values of each entry in one column: one gather for all, since XLA fails on many fused gathers."""
    leaves = jax.tree.leaves(tree)
    return jnp.concatenate([a.reshape(-1, a.shape[-1]).astype(jnp.result_type(*leaves)) for a in leaves])


def _unpack(rows: Array, tree: PyTree) -> PyTree:
    """Return columns as arrays like those of `tree`, with another batch size."""
    leaves, structure = jax.tree.flatten(tree)
    ends = np.cumsum([a[..., 0].size for a in leaves])
    parts = jnp.split(rows, ends[:-1])
    like = [p.reshape(*a.shape[:-1], -1).astype(a.dtype) for p, a in zip(parts, leaves, strict=True)]
    return jax.tree.unflatten(structure, like)


def _take(tree: PyTree, entries: Array) -> PyTree:
    return _unpack(_pack(tree)[:, entries], tree)


def _take_data(batch: BatchData, entries: Array) -> BatchData:
    """Return the data of some batch entries."""
    num = len(batch.tolerance)
    wide = jax.tree.map(lambda a: jnp.broadcast_to(a, (*a.shape[:-1], num)), batch[1:])
    return BatchData(batch.ocp.take(entries), *_take(wide, entries))


def _solve_open(batch: BatchData, loop: _Loop) -> _Loop:
    """Iterate until all entries are solved; the last unsolved ones are gathered into a smaller batch."""
    num = len(batch.tolerance)
    few = num // SHARE if num >= MANY else 0
    loop = jax.lax.while_loop(lambda s: jnp.sum(s.open) > few, lambda s: _iterate(batch, s), loop)
    if not few:
        return loop
    entries = jnp.argsort(~loop.open)[:few]
    rest = _solve_open(_take_data(batch, entries), _take(loop, entries))
    return _unpack(_pack(loop).at[:, entries].set(_pack(rest)), loop)


def _with_curvature(batch: BatchData, loop: _Loop, model: QPModel, more: PyTree) -> QPModel:
    """Return the model with second derivatives of the dynamics; a large batch may start with cheaper ones.

    A small batch would lose more time compiling both.
    """
    it = loop.iterate
    args = ([x[:-1] for x in it.X], it.U, it.costates, batch.stages, more)

    def with_those(curvature: Callable[..., Matrix | None]) -> Callable[[], QPModel]:
        return lambda: compute_once(lambda model, args: with_curvature(model, curvature(*args) or [], it.U[0]))(
            model, args
        )

    exact, early = with_those(batch.ocp.curvature), batch.ocp.early_curvature
    if len(batch.tolerance) < MANY or jax.eval_shape(early, *args) is None:
        return exact()
    late = loop.open & (loop.search.active | (loop.num_steps >= EARLY))
    return jax.lax.cond(jnp.any(late), exact, with_those(early))


def _iterate(batch: BatchData, loop: _Loop) -> _Loop:
    """Judge the iterates, and step those that are not solved; non-finite ones count as finished."""
    it, searched = loop.iterate, loop.open & loop.search.active
    expansion = batch.ocp.local_expansion([x[:-1] for x in it.X], it.U, batch.stages)
    model, more, error = compute_once(lambda it, expansion: qp_model(batch, it, expansion))(it, expansion)
    error = where(loop.open, error, loop.error)
    residual = worst(error)
    here = search_from(batch.ocp, batch.rows, batch.u_before, model, it, loop.search)
    rejected = searched & ~accepted(loop.search, here, loop.barrier, batch.tolerance)
    rejected &= ~(residual <= batch.tolerance) & (loop.search.halvings < HALVINGS)
    open_ = loop.open & ~(residual <= batch.tolerance) & (rejected | ~jnp.isnan(residual)) & ~loop.infeasible
    open_ &= loop.num_steps < batch.max_steps
    rejected &= open_
    halved = loop.search._replace(halvings=loop.search.halvings + 1)
    loop = loop._replace(search=where(rejected, halved, here), error=error, open=open_)
    step = lambda: _step_open(batch, loop, model, more, open_ & ~rejected)
    return jax.lax.cond(jnp.any(open_), step, lambda: loop)


def _step_open(batch: BatchData, loop: _Loop, model: QPModel, more: PyTree, stepped: Array) -> _Loop:
    """Step the `stepped` entries towards the solutions of their programs, solved to the tolerance in the last step."""
    last, search = loop.num_steps + 1 >= batch.max_steps, loop.search
    share = jnp.maximum(jnp.minimum(FORCING * worst(loop.error), COARSE), FINE * batch.tolerance)
    accuracy, most = jnp.where(last, batch.tolerance, share), jnp.where(last, LAST_STEPS, PROGRAM_STEPS)
    model, left = _with_curvature(batch, loop, model, more), jnp.where(stepped, 1.0, search.left)
    start = (model, loop.iterate, loop.barrier, search.gains, left, loop.qp_error, loop.infeasible, stepped)
    end = solve_programs(batch, Programs(*start, loop.qp_steps), accuracy, most)
    search = search._replace(end=where(stepped, end.iterate, search.end), gains=end.gains, left=end.left)
    return loop._replace(
        iterate=_next_point(batch, loop.open & search.active, search, end), search=search, barrier=end.barrier,
        qp_error=end.error, num_steps=loop.num_steps + loop.open, qp_steps=end.num_steps, infeasible=end.infeasible,
    )  # fmt: skip


def _next_point(batch: BatchData, searched: Array, search: LineSearch, end: Programs) -> BatchIterate:
    """Return the trial points of the `searched` entries, and the solutions of their programs for the others."""
    trial = lambda: trial_point(batch.ocp, batch.rows, batch.u_before, search, end.barrier)
    return where(searched, jax.lax.cond(jnp.any(searched), trial, lambda: end.iterate), end.iterate)


def _result(worst: Array, infeasible: Array, tolerance: Array) -> RESULTS:
    result = RESULTS.where(jnp.isfinite(worst), RESULTS.not_converged, RESULTS.non_finite)  # pyright: ignore[reportArgumentType]
    result = RESULTS.where(infeasible, RESULTS.infeasible, result)  # pyright: ignore[reportArgumentType]
    return RESULTS.where(worst <= tolerance, RESULTS.successful, result)  # pyright: ignore[reportArgumentType]


def solve_batch(
    ocp: AbstractBatchOCP,
    x0: Float[Array, "nx batch"],
    u_before: Float[Array, "nu batch"],
    params: PyTree,
    X: Float[Array, "nx N+1 batch"],
    U: Float[Array, "nu N batch"],
    options: Options,
    needed: Bool[Array, " batch"] | None = None,
) -> BatchSolution:
    """Solve a batch from the guess `X`, `U`; leaves of `params` are (N+1, batch) or (N+1, 1), the last row for the end.

    `options.max_steps` is the number of SQP iterations: 1 for a real-time iteration, whose program is solved to the
    tolerance. An entry's `result` is `successful` only where its KKT residual and violation are below the tolerance,
    and `infeasible` where dynamics and limits of its last linearisation were proven to have no common point near the
    iterate, within 100 in each of the scaled variables.
    Entries that are not `needed` stay at their guess and delay no others; each option may be given per entry (batch,).
    Where the residuals exceed `options.implicit` tolerances the entry is solved again, up to `options.restarts` times,
    from its guess with a smaller barrier and a line search.

    `X`, `U` and `cost` are differentiable in `ocp`, `x0`, `u_before` and `params`, in both modes, as exactly as the
    tolerance; guess, options and residuals carry no derivative. Where the residuals exceed `options.implicit`
    tolerances, or the point is no strict minimum, all derivatives are NaN.
    """
    return _differentiable(ocp, x0, u_before, params, X, U, options, needed)


@eqx.filter_custom_jvp
def _differentiable(ocp, x0, u_before, params, X, U, options, needed) -> BatchSolution:
    return _solve(ocp, x0, u_before, params, X, U, options, needed)[0]


@_differentiable.def_jvp
def _tangent(primals, tangents):
    ocp, x0, u_before, params, *_, options, _ = primals
    d_ocp, d_x0, d_before, d_params, *_ = tangents
    solution, it = _solve(*primals)
    batch = batch_data(ocp, u_before, params, it.U[0][0], options)
    x, stages = [x[:-1] for x in it.X], batch.stages
    model, more, _ = qp_model(batch, it, ocp.local_expansion(x, it.U, stages))
    model = with_curvature(model, ocp.curvature(x, it.U, it.costates, stages, more), it.U[0])
    start = list(jnp.zeros_like(x0) if d_x0 is None else d_x0)
    d_theta = (d_ocp, [None] * len(it.U) if d_before is None else list(d_before), d_params)
    dX, dU, d_cost, strict = solution_tangent(model, it, (ocp, list(u_before), params), d_theta, start)
    reached = jnp.maximum(solution.kkt, solution.violation) <= options.implicit * options.tolerance  # False on NaN
    mark = jnp.where(reached & strict, 1.0, jnp.nan).astype(x0.dtype)
    none = jax.tree.map(lambda _: None, solution)
    moved = lambda s: (s.X, s.U, s.cost)
    tangent = (mark * jnp.stack(dX), mark * jnp.stack(dU), mark * d_cost)
    return solution, eqx.tree_at(moved, none, tangent, is_leaf=lambda leaf: leaf is None)


def _solve(
    ocp: AbstractBatchOCP,
    x0: Array,
    u_before: Array,
    params: PyTree,
    X: Array,
    U: Array,
    options: Options,
    needed: Array | None,
) -> tuple[BatchSolution, BatchIterate]:
    large = jnp.full_like(U[0][0], jnp.inf)
    wide = lambda a, dtype: jnp.broadcast_to(jnp.asarray(a, dtype), large.shape)
    barrier = wide(options.barrier, large.dtype)
    batch = batch_data(ocp, u_before, params, U[0][0], options)
    needed = wide(True, bool) if needed is None else needed
    none, never = wide(0, jnp.int32), wide(False, bool)

    def begin(attempt: Array) -> _Loop:
        first = barrier * jnp.power(SMALLER, attempt).astype(large.dtype)
        start = first_iterate(batch, list(x0), list(X), list(U), first)
        search, error = no_search(start, never | (attempt > 0)), OptimalityError(large, large)
        return _Loop(
            start, search, first, error, qp_error=large, num_steps=none, qp_steps=none, infeasible=never, open=needed
        )

    def left(loop: _Loop, attempt: Array) -> Array:
        good = worst(loop.error) <= wide(options.implicit, large.dtype) * batch.tolerance
        return needed & ~good & ~loop.infeasible & (attempt <= wide(options.restarts, jnp.int32))

    def again(state: tuple[_Loop, Array]) -> tuple[_Loop, Array]:
        last, attempt = state
        open_, fresh = left(last, attempt), begin(attempt)
        loop = where(open_, fresh, last)
        loop = _solve_open(batch, loop._replace(open=open_))
        count = lambda new, old: jnp.where(open_, new + old, old)
        counts = {name: count(getattr(loop, name), getattr(last, name)) for name in ("num_steps", "qp_steps")}
        return loop._replace(**counts), attempt + 1

    end, _ = jax.lax.while_loop(lambda s: jnp.any(left(*s)), again, (begin(none[0]), none[0]))
    it = end.iterate
    result = jax.vmap(_result)(worst(end.error), end.infeasible, batch.tolerance)
    X, U = jnp.stack(it.X), jnp.stack(it.U)
    counts, cost = (end.num_steps, end.qp_steps), total_cost(ocp, split(params), list(u_before), it.X, it.U)
    return BatchSolution(X, U, cost, *end.error, end.qp_error, *counts, result), it
