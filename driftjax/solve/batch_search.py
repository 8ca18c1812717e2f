"""Line search of a batch: roll-outs of the dynamics under the feedback of a quadratic program, judged by a filter.

A trial point is a roll-out of the nonlinear dynamics along the step, with the defects closed in proportion to it (after
Mastalli et al. 2020): unstable dynamics stay near the plan, and no curvature of theirs is left as a defect that
shortens good steps. It is accepted if it lowers violation or barrier objective (Waechter and Biegler 2006, Sec. 2.3).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from driftjax.solve.batch_conditions import BatchIterate, QPModel, all_constraints, slack_residuals
from driftjax.solve.batch_newton import StepGains, no_gains
from driftjax.solve.batch_ocp import AbstractBatchOCP, Components
from driftjax.solve.batch_qp import BOUNDARY_FRACTION, central
from driftjax.solve.component_derivatives import dot
from driftjax.solve.compute_once import compute_once
from driftjax.solve.solution_derivative import total_cost

HALVINGS = 8  # of one step before its point is taken all the same
PROGRESS, LARGEST_VIOLATION = 1e-5, 10.0  # share of the violation that a step must gain; times 1 or the last one


class LineSearch(NamedTuple):
    """Search of each entry from a point towards the solution of its program."""

    active: Array  # whether steps are searched; else full linear ones are taken
    halvings: Array
    start: BatchIterate
    defects: Components  # at the start
    violation: Array  # sum of defects and limit residuals at the start
    cost: Array  # objective at the start
    logs: Array  # sum of the logarithms of the slacks at the start
    end: BatchIterate  # by the program
    gains: StepGains  # of its last Newton step
    left: Array  # share of the defects that the program leaves


def no_search(start: BatchIterate, active: Array) -> LineSearch:
    """Return a search that has not begun."""
    zero = jnp.zeros_like(start.U[0][0])
    large = jnp.full_like(zero, jnp.inf)
    none = jnp.zeros_like(active, jnp.int32)
    return LineSearch(active, none, start, start.costates, large, large, zero, start, no_gains(*start[:2]), zero)


def search_from(
    ocp: AbstractBatchOCP, rows: tuple[PyTree, PyTree], u_before: Components, model: QPModel, it: BatchIterate,
    last: LineSearch,
) -> LineSearch:  # fmt: skip
    """Begin a search at an iterate with its linearisation; `rows` are the parameters of the stages and of the end."""
    cost = total_cost(ocp, rows, u_before, it.X, it.U)
    apart = [jnp.sum(jnp.abs(v), axis=0) for v in (*model.c, *slack_residuals(ocp, u_before, model, it))]
    logs = sum((jnp.sum(jnp.log(s), axis=0) for s in it.slack), jnp.zeros_like(cost))
    return last._replace(
        halvings=jnp.zeros_like(last.halvings), start=it, defects=model.c,
        violation=sum(apart, jnp.zeros_like(cost)), cost=cost, logs=logs,
    )  # fmt: skip


def accepted(last: LineSearch, new: LineSearch, barrier: Array, tolerance: Array) -> Array:
    """Return whether a step lowers a violation above `tolerance`, or the objective of the barrier problem."""
    phi, phi_new = (each.cost - barrier * each.logs for each in (last, new))
    lower = (last.violation > tolerance) & (new.violation <= (1 - PROGRESS) * last.violation)
    better = phi_new <= phi - PROGRESS * last.violation + jnp.finfo(phi.dtype).eps * jnp.abs(phi)
    near = new.violation <= LARGEST_VIOLATION * jnp.maximum(1.0, last.violation)
    return (lower | better) & near & jnp.isfinite(phi_new)


def trial_point(
    ocp: AbstractBatchOCP, rows: tuple[PyTree, PyTree], u_before: Components, search: LineSearch, barrier: Array
) -> BatchIterate:
    """Roll out the dynamics under the feedback; multipliers and slacks move along the line.

    A limit that is open by itself is its own slack; only one that is closed keeps the slack of the line.
    """
    start, length = search.start, jnp.exp2(-search.halvings.astype(barrier.dtype))
    step = jax.tree.map(lambda a, b: length * (b - a), start, search.end)
    left = 1 - length * (1 - search.left)

    def move(carry: tuple[Components, Components], s: tuple):
        (x, from_line), (X, U, dX, dU, gains, defects, p) = carry, s
        dx = [a - b - d for a, b, d in zip(x, X, dX, strict=True)]
        du = [dot(Kx, dx) + dot(Ku, from_line) for Kx, Ku in zip(gains.x, gains.u, strict=True)]
        u = [a + b + c for a, b, c in zip(U, dU, du, strict=True)]
        y = [a - left * c for a, c in zip(ocp.step(x, u, p), defects, strict=True)]
        return (y, du), (y, u)

    begin = [x[0] for x in start.X], [jnp.zeros_like(left) for _ in start.U]
    before = lambda X: [x[:-1] for x in X]
    stages = (before(start.X), start.U, before(step.X), step.U, search.gains, search.defects, rows[0])
    X, U = jax.lax.scan(compute_once(move), begin, stages)[1]
    X = [jnp.concatenate([first[:1], x]) for first, x in zip(start.X, X, strict=True)]
    costates, line, dual = jax.tree.map(jnp.add, start[2:], step[2:])
    values = all_constraints(ocp, u_before, *rows, X, U)
    own = lambda value, first, s: jnp.where(value > (1 - BOUNDARY_FRACTION) * first, value, s)
    slack = [own(*each) for each in zip(values, start.slack, line, strict=True)]
    return BatchIterate(X, U, costates, slack, central(dual, slack, barrier, search.active))
