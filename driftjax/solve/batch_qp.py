"""Solve the quadratic programs of a batch from stored matrices: primal-dual interior point, one Riccati sweep a step.

The program is that of an SQP iteration: the model of the stages about a linearisation, the exact limits, and the exact
cost of input changes. Nothing here evaluates the problem's functions.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from driftjax.solve.batch_conditions import (
    BatchIterate,
    QPModel,
    bound_constraints,
    change_gradient,
    changes,
    filled,
    proves_infeasible,
    slack_residuals,
)
from driftjax.solve.batch_newton import StepGains, newton_system, newton_terms, solve_backward, solve_forward
from driftjax.solve.batch_ocp import AbstractBatchOCP, Components
from driftjax.solve.component_derivatives import dot, total

BOUNDARY_FRACTION = 0.995  # of the way to a bound that one step may take
LEAST = 0.2  # least barrier, over the tolerance; products of this size still count as solved
SHORT = 0.05  # length of a step to the limits below which infeasibility is looked for
CENTRALITY = 10.0  # factor by which a product of slack and dual may differ from the barrier


class QPStep(NamedTuple):
    """One iteration of the quadratic programs."""

    model: QPModel  # about the new iterate
    iterate: BatchIterate
    gains: StepGains  # of the Newton step
    primal_length: Array  # of the steps of the primal variables
    length: Array  # of the shorter of both steps
    infeasible: Array  # whether the program was proven to have no feasible point


def qp_step(
    ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate, barrier: Array, open_: Array
) -> QPStep:
    """Move the `open_` entries by one iteration."""
    newton, gains = _newton_step(ocp, u_before, model, it, barrier)
    step, dual_step = max_step_length(it.slack, newton.slack, open_), max_step_length(it.dual, newton.dual, open_)
    infeasible = _infeasible(ocp, u_before, model, it, newton, open_ & (step < SHORT))

    def move(values: Components, length: Array, steps: Components) -> Components:
        return [jnp.where(open_, v + length * d, v) for v, d in zip(values, steps, strict=True)]

    X, U, costates, slack = (move(v, step, d) for v, d in zip(it[:4], newton[:4], strict=True))
    dual = move(it.dual, dual_step, newton.dual)
    new = BatchIterate(X, U, costates, slack, central(dual, slack, barrier, open_))
    moved = BatchIterate(*([a - b for a, b in zip(*pair, strict=True)] for pair in zip(new, it, strict=True)))
    z, dN = stage_steps(moved)
    affine = lambda values, rows, steps: [total((v, dot(row, steps))) for v, row in zip(values, rows, strict=True)]
    # all of this is affine in the step
    updated = model._replace(
        c=[(1 - step) * c for c in model.c],
        h=affine(model.h, model.H, z),
        hN=affine(model.hN, model.HN, dN),
        g=affine(model.g, model.G, z),
        gN=affine(model.gN, model.GN, dN),
    )
    return QPStep(updated, new, gains, step, jnp.minimum(step, dual_step), infeasible)


def stage_steps(step: BatchIterate) -> tuple[Components, Components]:
    """Return the steps of state and input at each stage, and of the last state."""
    return [*(x[:-1] for x in step.X), *step.U], [x[-1] for x in step.X]


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


def central(dual: Components, slack: Components, barrier: Array, open_: Array) -> Components:
    """Return duals whose products with the slacks stay near the barrier; others would block the step."""
    near = lambda z, s: jnp.clip(z, barrier / (CENTRALITY * s), CENTRALITY * barrier / s)
    return [jnp.where(open_, near(z, s), z) for z, s in zip(dual, slack, strict=True)]


def next_barrier(it: BatchIterate, barrier: Array, length: Array, tolerance: Array) -> Array:
    """Return the next barrier parameter: it follows the mean product of slack and dual, faster after long steps."""
    if not it.slack:
        return barrier
    products = sum(jnp.sum(s * z, axis=0) for s, z in zip(it.slack, it.dual, strict=True))
    gap = products / sum(len(s) for s in it.slack)
    return jnp.maximum(jnp.clip((1 - length) ** 2, 0.1, 0.8) * gap, LEAST * tolerance)


def _newton_step(
    ocp: AbstractBatchOCP, u_before: Components, model: QPModel, it: BatchIterate, barrier: Array
) -> tuple[BatchIterate, StepGains]:
    """Solve the Newton system: backwards for gains, forwards for the step; the first state stays."""
    gaps, nu, zero = bound_constraints(ocp), len(it.U), jnp.zeros_like(barrier)
    residual = slack_residuals(ocp, u_before, model, it)
    inverse = [1 / slack for slack in it.slack]
    stiff = [z * i for z, i in zip(it.dual, inverse, strict=True)]
    push = [w * r - barrier * i for w, r, i in zip(stiff, residual, inverse, strict=True)]
    system = newton_system(ocp, model, stiff)
    terms = newton_terms(ocp, model, change_gradient(ocp, u_before, it), push)
    factors, backward = solve_backward(system, terms)
    dX, dU, costates = solve_forward(system, factors, backward, ([zero] * len(it.X), [zero] * nu))
    of = {"input": dU, "change": changes(dU, [zero] * nu), "state": dX}
    d_costates = [new - old for new, old in zip(costates, it.costates, strict=True)]
    newton = BatchIterate([jnp.concatenate([zero[None], dx]) for dx in dX], dU, d_costates, [], [])
    z, dN = stage_steps(newton)
    d_values = [gap.sign * of[gap.family][gap.entry] for gap in gaps]
    d_values += filled([dot(row, z) for row in model.G], dU[0])
    d_values += [d[None] for d in filled([dot(row, dN) for row in model.GN], zero)]
    d_slack = [d + r for d, r in zip(d_values, residual, strict=True)]
    d_dual = [(barrier - z * ds) / s - z for s, z, ds in zip(it.slack, it.dual, d_slack, strict=True)]
    return newton._replace(slack=d_slack, dual=d_dual), StepGains(factors.Kx, factors.Kw)


def max_step_length(values: Components, steps: Components, open_: Array) -> Array:
    """Return the step length at the fraction-to-boundary rule; 0 for solved entries."""
    if not values:
        return jnp.where(open_, 1.0, 0.0)
    rate = functools.reduce(jnp.maximum, [-d / v for v, d in zip(values, steps, strict=True)])
    return jnp.where(open_, jnp.minimum(1.0, BOUNDARY_FRACTION / jnp.maximum(jnp.max(rate, axis=0), 1e-12)), 0.0)
