"""Derivatives of a solution by the implicit function theorem, not through the iterations.

At the solution w = (X, U, multipliers, slacks) of the last barrier problem the optimality conditions F(w, theta) = 0
hold, so that dw = -(dF/dw)^-1 (dF/dtheta) dtheta. The matrix is the one of the Newton step; it is factorised once, by
a Riccati sweep, and the linear part of the sweep is done for each direction. Active limits are part of F: where a
slack is much smaller than its multiplier the limit holds in the derivative as well.
Sources: Amos et al. 2018 (differentiable MPC); Pirnay et al. 2012 (sensitivities of an interior point).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from driftjax.solve.batch_conditions import BatchIterate, QPModel, all_constraints, changes
from driftjax.solve.batch_newton import newton_system, newton_terms, solve_backward, solve_forward, substitute
from driftjax.solve.batch_ocp import AbstractBatchOCP, Components


def total_cost(
    ocp: AbstractBatchOCP, rows: tuple[PyTree, PyTree], u_before: Components, X: Components, U: Components
) -> Array:
    """Return the cost of each entry (batch,); `rows` are the parameters of the stages and of the end."""
    stages, last = rows
    cost = jnp.sum(ocp.cost([x[:-1] for x in X], U, stages), axis=0) + ocp.terminal([x[-1] for x in X], last)
    for change, weight in zip(changes(U, u_before), ocp.rate_weight(), strict=False):
        cost = cost + weight * jnp.sum(change**2, axis=0)
    return cost


def split(params: PyTree) -> tuple[PyTree, PyTree]:
    """Return the rows of the stages and of the end, of parameters with N+1 rows."""
    return jax.tree.map(lambda p: p[:-1], params), jax.tree.map(lambda p: p[-1], params)


def solution_tangent(
    model: QPModel,
    it: BatchIterate,
    theta: tuple[AbstractBatchOCP, Components, PyTree],
    d_theta: tuple,
    d_x0: Components,
) -> tuple[Components, Components, Array, Array]:
    """Return the derivatives of states, inputs and cost along `d_theta`, and whether each entry is a strict minimum.

    `theta` holds the problem, the input before the first and the parameters; `model` is its exact one at `it`.
    """
    ocp, u_before, _ = theta
    d_ocp, d_before, d_params = d_theta
    d_before = [jnp.zeros_like(u) if d is None else d for u, d in zip(u_before, d_before, strict=True)]
    stiff = [z / s for z, s in zip(it.dual, it.slack, strict=True)]
    system = newton_system(ocp, model, stiff)
    zero = [jnp.zeros_like(u) for u in it.U]
    blank = jax.tree.map(jnp.zeros_like, model)
    factors, _ = solve_backward(system, newton_terms(ocp, blank, zero, [jnp.zeros_like(z) for z in it.dual]))

    (gX, gU), c, gaps = _along(lambda *t: _conditions(it, *t), theta, (d_ocp, [None] * len(u_before), d_params))
    moved = model._replace(c=c, h=[*(g[:-1] for g in gX), *gU], hN=[g[-1] for g in gX])
    push = [weight * gap for weight, gap in zip(stiff, gaps, strict=True)]
    backward = substitute(system, factors, newton_terms(ocp, moved, zero, push))
    dX, dU, _ = solve_forward(system, factors, backward, (d_x0, d_before))
    dX = [jnp.concatenate([first[None], later]) for first, later in zip(d_x0, dX, strict=True)]
    cost = lambda ocp, u_before, params, X, U: total_cost(ocp, split(params), u_before, X, U)
    d_cost = _along(cost, (*theta, it.X, it.U), (d_ocp, d_before, d_params, dX, dU))
    return dX, dU, d_cost, jnp.all(factors.convex, axis=0)


def _conditions(it: BatchIterate, ocp: AbstractBatchOCP, u_before: Components, params: PyTree) -> tuple:
    """Return the gradient of the Lagrangian in states and inputs, defects and limits, at fixed variables."""
    stages, last = split(params)

    def parts(X: Components, U: Components) -> tuple[Components, Components]:
        y = ocp.step([x[:-1] for x in X], U, stages)
        defects = [a - x[1:] for a, x in zip(y, X, strict=True)]
        return defects, all_constraints(ocp, u_before, stages, last, X, U)

    def lagrangian(X: Components, U: Components) -> Array:
        defects, limits = parts(X, U)
        terms = [jnp.sum(y * c) for y, c in zip(it.costates, defects, strict=True)]
        terms += [-jnp.sum(z * g) for z, g in zip(it.dual, limits, strict=True)]
        return jnp.sum(total_cost(ocp, (stages, last), u_before, X, U)) + sum(terms)

    return jax.grad(lagrangian, (0, 1))(it.X, it.U), *parts(it.X, it.U)


def _along(function: Callable[..., PyTree], theta: tuple, d_theta: tuple) -> PyTree:
    """Return the directional derivative; `d_theta` is None for a constant `theta`."""
    out, d_out = eqx.filter_jvp(function, theta, d_theta)
    return jax.tree.map(lambda y, d: jnp.zeros_like(y) if d is None else d, out, d_out)
