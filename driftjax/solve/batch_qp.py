"""Solve the quadratic programs of a batch from stored matrices: primal-dual interior point, one Riccati sweep a step.

The program is that of an SQP iteration: the model of the stages about a linearisation, the exact limits, and the exact
cost of input changes. Nothing here evaluates the problem's functions.
"""

import functools

import jax
import jax.numpy as jnp
from jax import Array

from driftjax.solve.batch_conditions import (
    BatchIterate,
    QPModel,
    bound_constraints,
    changes,
    proves_infeasible,
    slack_residuals,
)
from driftjax.solve.batch_newton import newton_system, newton_terms, solve_backward, solve_forward
from driftjax.solve.batch_ocp import AbstractBatchOCP, Components
from driftjax.solve.component_derivatives import dot, total
from driftjax.solve.interior_point import BOUNDARY_FRACTION

LEAST = 0.2  # least barrier, over the tolerance; products of this size still count as solved
SHORT = 0.05  # length of a step to the limits below which infeasibility is looked for
CENTRALITY = 10.0  # factor by which a product of slack and dual may differ from the barrier


def qp_step(
    ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate, barrier: Array, open_: Array
) -> tuple[QPModel, BatchIterate, Array, Array]:
    """Return the model after one iteration of the `open_` entries, iterate, length of the step, whether infeasible."""
    newton = _newton_step(ocp, u_before, model, it, barrier)
    step, dual_step = max_step_length(it.slack, newton.slack, open_), max_step_length(it.dual, newton.dual, open_)
    infeasible = _infeasible(ocp, u_before, model, it, newton, open_ & (step < SHORT))

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
    return updated, new, jnp.minimum(step, dual_step), infeasible


def _infeasible(
    ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate, newton: BatchIterate, tested: Array
) -> Array:
    """Return whether the program of a `tested` entry is proven to have no feasible point.

    Without one steps become short and multipliers grow, those of the full Newton step towards a proof. A program
    without limits has one.
    """
    if not it.slack:
        return jnp.zeros_like(tested)
    full = lambda values, steps: [v + d for v, d in zip(values, steps, strict=True)]
    dual = [jnp.maximum(z, 0.0) for z in full(it.dual, newton.dual)]
    proof = it._replace(costates=full(it.costates, newton.costates), dual=dual)
    prove = lambda: tested & proves_infeasible(ocp, u_before, model, proof)
    return jax.lax.cond(jnp.any(tested), prove, lambda: jnp.zeros_like(tested))


def _central(dual: Array, slack: Array, barrier: Array, open_: Array) -> Array:
    """Return duals with slack products near the barrier: an entry at a limit without its dual cannot move."""
    return jnp.where(open_, jnp.clip(dual, barrier / (CENTRALITY * slack), CENTRALITY * barrier / slack), dual)


def next_barrier(it: BatchIterate, barrier: Array, length: Array, tolerance: Array) -> Array:
    """Return the next barrier parameter: it follows the mean product of slack and dual, faster after long steps."""
    if not it.slack:
        return barrier
    products = sum(jnp.sum(s * z, axis=0) for s, z in zip(it.slack, it.dual, strict=True))
    gap = products / (len(it.slack) * it.slack[0].shape[0])
    return jnp.maximum(jnp.clip((1 - length) ** 2, 0.1, 0.8) * gap, LEAST * tolerance)


def _newton_step(
    ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate, barrier: Array
) -> BatchIterate:
    """Solve the Newton system: backwards for value and policy, forwards for the step; the first state stays."""
    gaps, nu, zero = bound_constraints(ocp), len(it.U), jnp.zeros_like(barrier)
    residual = slack_residuals(ocp, u_before, it)
    inverse = [1 / slack for slack in it.slack]
    stiff = [z * i for z, i in zip(it.dual, inverse, strict=True)]
    push = [w * r - barrier * i for w, r, i in zip(stiff, residual, inverse, strict=True)]
    system = newton_system(ocp, model, stiff)
    factors, policy = solve_backward(system, newton_terms(ocp, u_before, model, it, push))
    dX, dU, costates = solve_forward(system, factors, policy)
    of = {"input": dU, "change": changes(dU, [zero] * nu), "state": dX}
    d_slack = [gap.sign * of[gap.family][gap.entry] + r for gap, r in zip(gaps, residual, strict=True)]
    d_dual = [(barrier - z * ds) / s - z for s, z, ds in zip(it.slack, it.dual, d_slack, strict=True)]
    d_costates = [new - old for new, old in zip(costates, it.costates, strict=True)]
    return BatchIterate([jnp.concatenate([zero[None], dx]) for dx in dX], dU, d_costates, d_slack, d_dual)


def max_step_length(values: Components, steps: Components, open_: Array) -> Array:
    """Return the step length at the fraction-to-boundary rule; 0 for solved entries."""
    if not values:
        return jnp.where(open_, 1.0, 0.0)
    rate = functools.reduce(jnp.maximum, [-d / v for v, d in zip(values, steps, strict=True)])
    return jnp.where(open_, jnp.minimum(1.0, BOUNDARY_FRACTION / jnp.maximum(jnp.max(rate, axis=0), 1e-12)), 0.0)
