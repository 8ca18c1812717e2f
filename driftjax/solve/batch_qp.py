"""Solve the quadratic programs of a batch from stored matrices: primal-dual interior point, one Riccati sweep a step.

The program is that of an SQP iteration: the model of the stages about a linearisation, the exact limits, and the exact
cost of input changes. Nothing here evaluates the problem's functions.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from driftjax.solve.batch_ocp import AbstractBatchOCP, Components
from driftjax.solve.component_derivatives import Entry, Matrix, column, dot, total
from driftjax.solve.compute_once import compute_once
from driftjax.solve.interior_point import BOUNDARY_FRACTION
from driftjax.solve.riccati_componentwise import CostToGo, Policy, StageSystem, backward_stage, forward_stage

LimitTerms = Callable[[str, int], list[Array]]  # multiplier terms of the limits of one entry of a family
CENTRALITY = 10.0  # factor by which a product of slack and dual may differ from the barrier


class BatchIterate(NamedTuple):
    """Iterate of a batch, components (stages, batch); slacks and duals in the order of `bound_constraints`."""

    X: Components  # (N+1, batch)
    U: Components  # (N, batch)
    costates: Components  # (N, batch), of the dynamics into x_1..x_N
    slack: Components  # (N, batch)
    dual: Components


class QPModel(NamedTuple):
    """Quadratic model about an iterate, without limits and cost of input changes; entries (N, batch), None for zero."""

    M: Matrix  # of the next state in (x, u)
    H: Matrix  # of the Lagrangian, in (x, u)
    HN: Matrix  # of the terminal cost, (batch,)
    c: Components  # defects
    h: list[Entry]  # of the cost, in (x, u)
    hN: list[Entry]  # of the terminal cost, (batch,)


class OptimalityError(NamedTuple):
    """Violation of the optimality conditions at an iterate."""

    kkt: Array  # scaled stationarity and complementarity
    violation: Array  # worst defect or violation of a limit


class BoundConstraint(NamedTuple):
    """Limit of one variable: sign (y - bound) >= 0 for an entry of a family."""

    family: str
    entry: int
    sign: float
    bound: Array | float


def bound_constraints(ocp: AbstractBatchOCP) -> list[BoundConstraint]:
    """Return the limits that exist: of inputs, their changes, states."""
    families = (("input", ocp.input_limits()), ("change", ocp.change_limits()), ("state", ocp.state_limits()))
    return [
        BoundConstraint(family, i, sign, bound)
        for family, limits in families
        for i, pair in enumerate(limits)
        for sign, bound in zip((1.0, -1.0), pair, strict=True)
        if bound is not None
    ]


def constraint_values(gaps: list[BoundConstraint], u: Components, change: Components, x_next: Components) -> Components:
    """Evaluate the constraints; positive within the limits."""
    of = {"input": u, "change": change, "state": x_next}
    return [gap.sign * (of[gap.family][gap.entry] - gap.bound) for gap in gaps]


def changes(U: Components, u_before: Components) -> Components:
    """Return the change of the input at each stage (N, batch); `u_before` (batch,) is the one before the first."""
    return [u - jnp.concatenate([b[None], u[:-1]]) for u, b in zip(U, u_before, strict=True)]


def slack_residuals(ocp: AbstractBatchOCP, u_before: Components, it: BatchIterate) -> Components:
    """Return constraint value less slack of each limit."""
    g = constraint_values(bound_constraints(ocp), it.U, changes(it.U, u_before), [x[1:] for x in it.X])
    return [gap - slack for gap, slack in zip(g, it.slack, strict=True)]


def _filled(entries: Any, like: Array) -> Any:
    """Replace None by zeros."""
    return jax.tree.map(lambda e: jnp.zeros_like(like) if e is None else e, entries, is_leaf=lambda e: e is None)


def _of(gaps: list[BoundConstraint], family: str, entry: int, values: Components) -> Components:
    """Return the values that belong to one entry of a family."""
    return [v for gap, v in zip(gaps, values, strict=True) if (gap.family, gap.entry) == (family, entry)]


def optimality_error(ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate) -> OptimalityError:
    """Return the optimality error: of the problem where `model` is its linearisation there, else of the QP.

    Stationarity is scaled by the size of the multipliers (Waechter and Biegler 2006, Eq. 5).
    """
    gaps, nx, change_gradient = bound_constraints(ocp), len(it.X), _change_gradient(ocp, u_before, it)
    limit_terms = [-gap.sign * z for gap, z in zip(gaps, it.dual, strict=True)]
    slope = [total((h, dot(column(model.M, i), it.costates))) for i, h in enumerate(model.h)]
    unbalanced = _stationarity(
        slope, model.hN, change_gradient, it, lambda family, i: _of(gaps, family, i, limit_terms)
    )
    products = [slack * z for slack, z in zip(it.slack, it.dual, strict=True)]
    size = sum(jnp.sum(jnp.abs(v), axis=0) for v in (*it.costates, *it.dual))
    scale = jnp.maximum(1.0, size / (it.costates[0].shape[0] * (nx + len(it.dual))) / 100)
    return OptimalityError(
        _largest([*unbalanced, *products]) / scale, _largest([*model.c, *slack_residuals(ocp, u_before, it)])
    )


def _change_gradient(ocp: AbstractBatchOCP, u_before: Components, it: BatchIterate) -> Components:
    """Return the gradient of the cost of input changes."""
    weight = ocp.rate_weight() or [0.0] * len(it.U)
    return [2 * w * change for w, change in zip(weight, changes(it.U, u_before), strict=True)]


def _stationarity(
    slope: list[Entry], end: list[Entry], change_gradient: Components, it: BatchIterate, limit_terms: LimitTerms
) -> Components:
    """Return the derivatives of the Lagrangian in each later state, in the last state, and in each input."""
    nx = len(it.X)
    slope = _filled(slope, it.U[0])
    own = [total((-it.costates[i], *limit_terms("state", i))) for i in range(nx)]
    rx = [slope[i][1:] + own[i][:-1] for i in range(nx)]
    rN = [total((own[i][-1], end[i]))[None] for i in range(nx)]
    rw = [total((change_gradient[l], *limit_terms("change", l))) for l in range(len(change_gradient))]
    ru = [total((slope[nx + l], *limit_terms("input", l), w)) for l, w in enumerate(rw)]
    return [*rx, *rN, *(u[:-1] - w[1:] for u, w in zip(ru, rw, strict=True)), *(u[-1:] for u in ru)]


def _largest(values: Sequence[Array]) -> Array:
    """Return the largest magnitude over stages and components."""
    return functools.reduce(jnp.maximum, [jnp.max(jnp.abs(v), axis=0, initial=0.0) for v in values])


def qp_step(
    ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate, barrier: Array, open_: Array
) -> tuple[QPModel, BatchIterate, Array]:
    """Return gradients and defects, iterate and length of the step after one iteration of the `open_` entries."""
    newton = _newton_step(ocp, u_before, model, it, barrier)
    step, dual_step = max_step_length(it.slack, newton.slack, open_), max_step_length(it.dual, newton.dual, open_)

    def move(values: Components, length: Array, steps: Components) -> Components:
        return [jnp.where(open_, v + length * d, v) for v, d in zip(values, steps, strict=True)]

    X, U, costates, slack = (move(v, step, d) for v, d in zip(it[:4], newton[:4], strict=True))
    dual = move(it.dual, dual_step, newton.dual)
    new = BatchIterate(
        X, U, costates, slack, [_central(z, s, barrier, open_) for z, s in zip(dual, slack, strict=True)]
    )
    z = [a - b for a, b in zip((*(x[:-1] for x in new.X), *new.U), (*(x[:-1] for x in it.X), *it.U), strict=True)]
    dN = [a[-1] - b[-1] for a, b in zip(new.X, it.X, strict=True)]
    # all of this is affine in the step
    updated = model._replace(
        c=[(1 - step) * c for c in model.c],
        h=[total((h, dot(row, z))) for h, row in zip(model.h, model.H, strict=True)],
        hN=[total((h, dot(row, dN))) for h, row in zip(model.hN, model.HN, strict=True)],
    )
    return updated, new, jnp.minimum(step, dual_step)


def _central(dual: Array, slack: Array, barrier: Array, open_: Array) -> Array:
    """Return duals with slack products near the barrier: an entry at a limit without its dual cannot move."""
    return jnp.where(open_, jnp.clip(dual, barrier / (CENTRALITY * slack), CENTRALITY * barrier / slack), dual)


def next_barrier(it: BatchIterate, barrier: Array, length: Array, tolerance: Array) -> Array:
    """Return the next barrier parameter: it follows the mean product of slack and dual, faster after long steps."""
    if not it.slack:
        return barrier
    products = sum(jnp.sum(s * z, axis=0) for s, z in zip(it.slack, it.dual, strict=True))
    gap = products / (len(it.slack) * it.slack[0].shape[0])
    return jnp.maximum(jnp.clip((1 - length) ** 2, 0.1, 0.8) * gap, 0.1 * tolerance)


def _newton_step(
    ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate, barrier: Array
) -> BatchIterate:
    """Solve the Newton system: backwards for value and policy, forwards for the step; the first state stays."""
    gaps, nx, nu, zero = bound_constraints(ocp), len(it.X), len(it.U), jnp.zeros_like(barrier)
    slack_residual = slack_residuals(ocp, u_before, it)
    local, stiff, pull = _local(ocp, u_before, model, it, slack_residual, barrier)
    wide = lambda entries: jax.tree.map(lambda e: jnp.broadcast_to(e, it.U[0].shape), entries)

    def back(value: CostToGo, s: tuple[StageSystem, list[Entry], list[Entry]]):
        local, stiff, pull = s
        P = [[total((value.P[i][j], stiff[i] if i == j else None)) for j in range(nx)] for i in range(nx)]
        after = value._replace(P=P, p=[total(pair) for pair in zip(value.p, pull, strict=True)])
        value, policy = backward_stage(after, local)
        return _filled(value, zero), _filled((policy, (after.p, after.P, after.S)), zero)

    def forth(carry: tuple[Components, Components], s):
        policy, local, (p, P, S) = s
        dx, du = forward_stage(Policy(*policy), local, *carry)
        costate = [total((p[i], dot(P[i], dx), dot(S[i], du))) for i in range(nx)]
        return (dx, du), (dx, du, costate)

    gradient, P = _filled((model.hN, model.HN), zero)
    blank = lambda n: [[zero] * nu for _ in range(n)]
    begin = CostToGo(
        [[e + zero for e in row] for row in P], blank(nx), blank(nu), [e + zero for e in gradient], [zero] * nu
    )
    local = wide(local)
    ahead = jax.lax.scan(compute_once(back), begin, (local, wide(stiff), wide(pull)), reverse=True)[1]
    dX, dU, costates = jax.lax.scan(compute_once(forth), ([zero] * nx, [zero] * nu), (ahead[0], local, ahead[1]))[1]
    of = {"input": dU, "change": changes(dU, [zero] * nu), "state": dX}
    d_slack = [gap.sign * of[gap.family][gap.entry] + r for gap, r in zip(gaps, slack_residual, strict=True)]
    d_dual = [(barrier - z * ds) / s - z for s, z, ds in zip(it.slack, it.dual, d_slack, strict=True)]
    d_costates = [new - old for new, old in zip(costates, it.costates, strict=True)]
    return BatchIterate([jnp.concatenate([zero[None], dx]) for dx in dX], dU, d_costates, d_slack, d_dual)


def _local(
    ocp: AbstractBatchOCP,
    u_before: Components,
    model: QPModel,
    it: BatchIterate,
    slack_residual: Components,
    barrier: Array,
) -> tuple[StageSystem, list[Entry], list[Entry]]:
    """Return the Newton system with slacks and duals eliminated; second and first derivatives of the state after."""
    gaps, nx, nu = bound_constraints(ocp), len(it.X), len(it.U)
    inv = [1 / slack for slack in it.slack]
    stiff = [z * i for z, i in zip(it.dual, inv, strict=True)]
    pull = [gap.sign * (w * m - barrier * i) for gap, w, m, i in zip(gaps, stiff, slack_residual, inv, strict=True)]
    weight, change_gradient = ocp.rate_weight() or [0.0] * nu, _change_gradient(ocp, u_before, it)
    H = [[total((model.H[i][j], *(_of(gaps, "input", i - nx, stiff) if i == j >= nx else ())))
          for j in range(nx + nu)] for i in range(nx + nu)]  # fmt: skip
    local = StageSystem(
        A=[row[:nx] for row in model.M],
        B=[row[nx:] for row in model.M],
        c=list(model.c),
        H=H,
        h=[total((h, *(_of(gaps, "input", i - nx, pull) if i >= nx else ()))) for i, h in enumerate(model.h)],
        rate=[
            total((2 * weight[l] + jnp.zeros_like(change_gradient[l]), *_of(gaps, "change", l, stiff)))
            for l in range(nu)
        ],
        pull=[total((change_gradient[l], *_of(gaps, "change", l, pull))) for l in range(nu)],
    )
    state = lambda values: [total(_of(gaps, "state", i, values)) for i in range(nx)]
    return local, state(stiff), state(pull)


def max_step_length(values: Components, steps: Components, open_: Array) -> Array:
    """Return the step length at the fraction-to-boundary rule; 0 for solved entries."""
    if not values:
        return jnp.where(open_, 1.0, 0.0)
    rate = functools.reduce(jnp.maximum, [-d / v for v, d in zip(values, steps, strict=True)])
    return jnp.where(open_, jnp.minimum(1.0, BOUNDARY_FRACTION / jnp.maximum(jnp.max(rate, axis=0), 1e-12)), 0.0)
