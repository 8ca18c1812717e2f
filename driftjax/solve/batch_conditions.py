"""Optimality conditions of a batch: limits as constraints, residuals of a problem or of its quadratic model."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from driftjax.solve.batch_ocp import AbstractBatchOCP, Components
from driftjax.solve.component_derivatives import Entry, Matrix, column, dot, total

NEAR = 100.0  # distance in any variable within which infeasibility is proven; variables are scaled to order one
LimitTerms = Callable[[str, int], list[Array]]  # multiplier terms of the limits of one entry of a family


class BatchIterate(NamedTuple):
    """Iterate of a batch, components (stages, batch).

    Slacks and duals are those of `bound_constraints`, of the stages' constraints, and of the end's (1, batch).
    """

    X: Components  # (N+1, batch)
    U: Components  # (N, batch)
    costates: Components  # (N, batch), of the dynamics into x_1..x_N
    slack: Components
    dual: Components


class QPModel(NamedTuple):
    """Quadratic model about an iterate, without limits and cost of input changes; entries (N, batch), None for zero.

    Those of the end are (batch,).
    """

    M: Matrix  # of the next state in (x, u)
    H: Matrix  # of the Lagrangian, in (x, u)
    HN: Matrix  # of the terminal cost
    G: Matrix  # of the constraints in (x, u)
    GN: Matrix  # of the terminal constraints
    c: Components  # defects
    h: list[Entry]  # of the cost, in (x, u)
    hN: list[Entry]  # of the terminal cost
    g: Components  # constraint values
    gN: Components  # terminal constraint values, (1, batch)


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


def all_constraints(
    ocp: AbstractBatchOCP, u_before: Components, stages: PyTree, last: PyTree, X: Components, U: Components
) -> Components:
    """Evaluate limits, constraints and terminal constraints, in the order of slacks."""
    values = constraint_values(bound_constraints(ocp), U, changes(U, u_before), [x[1:] for x in X])
    values += ocp.constraints([x[:-1] for x in X], U, stages)
    return values + [value[None] for value in ocp.terminal_constraints([x[-1] for x in X], last)]


def changes(U: Components, u_before: Components) -> Components:
    """Return the change of the input at each stage (N, batch); `u_before` (batch,) is the one before the first."""
    return [u - jnp.concatenate([b[None], u[:-1]]) for u, b in zip(U, u_before, strict=True)]


def slack_residuals(ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate) -> Components:
    """Return constraint value less slack of each limit and constraint."""
    bounds = constraint_values(bound_constraints(ocp), it.U, changes(it.U, u_before), [x[1:] for x in it.X])
    return [value - slack for value, slack in zip((*bounds, *model.g, *model.gN), it.slack, strict=True)]


def split_by_kind(model: QPModel, values: Components) -> tuple[Components, Components, Components]:
    """Split values in the order of slacks: of limits, of constraints, of terminal constraints (batch,)."""
    end, stage = len(values) - len(model.gN), len(values) - len(model.gN) - len(model.g)
    return values[:stage], values[stage:end], [value[0] for value in values[end:]]


def filled(entries: Any, like: Array) -> Any:
    """Replace None by zeros."""
    return jax.tree.map(lambda e: jnp.zeros_like(like) if e is None else e, entries, is_leaf=lambda e: e is None)


def terms_of(gaps: list[BoundConstraint], family: str, entry: int, values: Components) -> Components:
    """Return the values that belong to one entry of a family."""
    return [v for gap, v in zip(gaps, values, strict=True) if (gap.family, gap.entry) == (family, entry)]


def optimality_error(ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate) -> OptimalityError:
    """Return the optimality error: of the problem where `model` is its linearisation there, else of the QP.

    Stationarity is scaled by the size of the multipliers (Waechter and Biegler 2006, Eq. 5).
    """
    stage, end, of_limits = _constraint_terms(ocp, model, it)
    slope, end = ([total(pair) for pair in zip(*pairs, strict=True)] for pairs in ((model.h, stage), (model.hN, end)))
    unbalanced = _stationarity(slope, end, change_gradient(ocp, u_before, it), it, of_limits)
    products = [slack * z for slack, z in zip(it.slack, it.dual, strict=True)]
    size = _multiplier_size(it) / sum(len(v) for v in (*it.costates, *it.dual))
    return OptimalityError(
        _largest([*unbalanced, *products]) / jnp.maximum(1.0, size / 100),
        _largest([*model.c, *slack_residuals(ocp, u_before, model, it)]),
    )


def proves_infeasible(ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate) -> Array:
    """Return whether the multipliers prove that no point near meets defects and limits of the model (bool, batch).

    With multipliers y of the defects c and z >= 0 of the limits g >= 0, y'c - z'g is affine in the variables and not
    positive at a feasible point (Farkas' lemma). Its value at the iterate must exceed what its gradient can take away
    within `NEAR` in each variable, and rounding.
    """
    stage, end, of_limits = _constraint_terms(ocp, model, it)
    gradient = _stationarity(stage, end, [jnp.zeros_like(u) for u in it.U], it, of_limits)
    gaps = [r + s for r, s in zip(slack_residuals(ocp, u_before, model, it), it.slack, strict=True)]
    value = _sum([y * c for y, c in zip(it.costates, model.c, strict=True)])
    value = value - _sum([z * g for z, g in zip(it.dual, gaps, strict=True)])
    size = _multiplier_size(it)
    return value > NEAR * _sum([jnp.abs(g) for g in gradient]) + jnp.finfo(size.dtype).eps ** 0.5 * size


def _constraint_terms(
    ocp: AbstractBatchOCP, model: QPModel, it: BatchIterate
) -> tuple[list[Entry], list[Entry], LimitTerms]:
    """Return the multiplier terms of the Lagrangian's gradient: in (x, u), in the last state, and of the limits."""
    gaps, nx = bound_constraints(ocp), len(it.X)
    bounds, stage, end = split_by_kind(model, [-z for z in it.dual])
    limit_terms = [gap.sign * z for gap, z in zip(gaps, bounds, strict=True)]
    dynamics = [total((dot(column(model.M, i), it.costates), dot(column(model.G, i), stage)))
                for i in range(nx + len(it.U))]  # fmt: skip
    ends = [dot(column(model.GN, i), end) for i in range(nx)]
    return dynamics, ends, lambda family, i: terms_of(gaps, family, i, limit_terms)


def _multiplier_size(it: BatchIterate) -> Array:
    return _sum([jnp.abs(v) for v in (*it.costates, *it.dual)])


def _sum(values: Sequence[Array]) -> Array:
    return functools.reduce(jnp.add, [jnp.sum(v, axis=0) for v in values])


def change_gradient(ocp: AbstractBatchOCP, u_before: Components, it: BatchIterate) -> Components:
    """Return the gradient of the cost of input changes."""
    weight = ocp.rate_weight() or [0.0] * len(it.U)
    return [2 * w * change for w, change in zip(weight, changes(it.U, u_before), strict=True)]


def _stationarity(
    slope: list[Entry], end: list[Entry], of_changes: Components, it: BatchIterate, limit_terms: LimitTerms
) -> Components:
    """Return the derivatives of the Lagrangian in each later state, in the last state, and in each input."""
    nx = len(it.X)
    slope = filled(slope, it.U[0])
    own = [total((-it.costates[i], *limit_terms("state", i))) for i in range(nx)]
    rx = [slope[i][1:] + own[i][:-1] for i in range(nx)]
    rN = [total((own[i][-1], end[i]))[None] for i in range(nx)]
    rw = [total((pull, *limit_terms("change", l))) for l, pull in enumerate(of_changes)]
    ru = [total((slope[nx + l], *limit_terms("input", l), w)) for l, w in enumerate(rw)]
    return [*rx, *rN, *(u[:-1] - w[1:] for u, w in zip(ru, rw, strict=True)), *(u[-1:] for u in ru)]


def _largest(values: Sequence[Array]) -> Array:
    """Return the largest magnitude over stages and components."""
    return functools.reduce(jnp.maximum, [jnp.max(jnp.abs(v), axis=0, initial=0.0) for v in values])
