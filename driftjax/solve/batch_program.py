"""Quadratic programs of a batch: linearise its problems at an iterate, and solve the resulting programs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from driftjax.solve.batch_conditions import (
    BatchIterate,
    OptimalityError,
    QPModel,
    all_constraints,
    optimality_error,
)
from driftjax.solve.batch_newton import StepGains
from driftjax.solve.batch_ocp import AbstractBatchOCP, Components
from driftjax.solve.batch_qp import next_barrier, qp_step
from driftjax.solve.component_derivatives import Entry, Matrix, hessian, total
from driftjax.solve.compute_once import compute_once
from driftjax.solve.ocp import Options
from driftjax.solve.solution_derivative import split

LAST_STEPS = 60  # interior-point iterations of a program that is solved to the tolerance
SLACK_FLOOR = 0.1  # least first slack, over the root of the barrier: a smaller one is pressed to its limit at once


class BatchData(NamedTuple):
    """Data of a batch of problems."""

    ocp: AbstractBatchOCP
    stages: PyTree  # parameters (N, batch) or (N, 1)
    last: PyTree  # those of the end (batch,) or (1,)
    u_before: Components
    tolerance: Array  # of each entry
    max_steps: Array

    @property
    def rows(self) -> tuple[PyTree, PyTree]:
        """Return the parameters of the stages and of the end."""
        return self.stages, self.last


def batch_data(ocp: AbstractBatchOCP, u_before: Array, params: PyTree, like: Array, options: Options) -> BatchData:
    """Return the data of a batch whose arrays (batch,) are of the size and type of `like`."""
    wide = lambda a, dtype: jnp.broadcast_to(jnp.asarray(a, dtype), like.shape)
    limits = wide(options.tolerance, like.dtype), wide(options.max_steps, jnp.int32)
    return BatchData(ocp, *split(params), list(u_before), *limits)


def first_iterate(batch: BatchData, x0: Components, X: Components, U: Components, barrier: Array) -> BatchIterate:
    """Return the iterate of a guess, from the first state, with slacks and duals at a barrier."""
    X = [x.at[0].set(first) for x, first in zip(X, x0, strict=True)]
    values = all_constraints(batch.ocp, batch.u_before, *batch.rows, X, U)
    slack = [jnp.maximum(value, SLACK_FLOOR * jnp.sqrt(barrier)) for value in values]
    return BatchIterate(X, U, [jnp.zeros_like(x[1:]) for x in X], slack, [barrier / s for s in slack])


def qp_model(batch: BatchData, it: BatchIterate, expansion: PyTree) -> tuple[QPModel, PyTree, OptimalityError]:
    """Return the model at an iterate, without second derivatives of the dynamics, what these need, and the error."""
    ocp, nx = batch.ocp, len(it.X)
    x, xN = [x[:-1] for x in it.X], [x[-1] for x in it.X]
    y, M, more = ocp.linearise(x, it.U, batch.stages, expansion)
    h, H = hessian(lambda *z: ocp.cost(list(z[:nx]), list(z[nx:]), batch.stages), *x, *it.U, jacobian=ocp.jacobian)
    hN, HN = hessian(lambda *x: ocp.terminal(list(x), batch.last), *xN, jacobian=ocp.jacobian)
    g, G = ocp.jacobian(lambda *z: ocp.constraints(list(z[:nx]), list(z[nx:]), batch.stages), *x, *it.U)
    gN, GN = ocp.jacobian(lambda *x: ocp.terminal_constraints(list(x), batch.last), *xN)
    model = QPModel(
        M=M, H=H, HN=HN, G=G, GN=GN, c=[a - b[1:] for a, b in zip(y, it.X, strict=True)],
        h=_full(h, it.U[0]), hN=_full(hN, xN[0]), g=g, gN=[value[None] for value in gN],
    )  # fmt: skip
    return model, more, optimality_error(ocp, batch.u_before, model, it)


def _full(entries: list[Entry], like: Array) -> list[Array]:
    return [jnp.zeros_like(like) if e is None else jnp.broadcast_to(e, like.shape) for e in entries]


def with_curvature(model: QPModel, curvature: Matrix, like: Array) -> QPModel:
    """Add second derivatives of the dynamics in (x, u) to the model of a linearisation."""
    rows = zip(model.H, curvature, strict=True)
    return model._replace(H=[_full([total(pair) for pair in zip(*row, strict=True)], like) for row in rows])


def worst(error: OptimalityError) -> Array:
    """Return the larger of both errors."""
    return jnp.maximum(error.kkt, error.violation)


def where(chosen: Array, new: PyTree, old: PyTree) -> PyTree:
    """Return the values of the `chosen` entries from `new`, of others from `old`."""
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), new, old)


class Programs(NamedTuple):
    """Quadratic programs while they are solved."""

    model: QPModel
    iterate: BatchIterate
    barrier: Array
    gains: StepGains  # of the last Newton step
    left: Array  # share of the defects that is left
    error: Array  # worst of optimality error and violation
    infeasible: Array  # whether proven to have no feasible point
    open: Array  # whether still to be improved
    num_steps: Array  # interior-point iterations so far


def solve_programs(batch: BatchData, programs: Programs, accuracy: Array, most: Array) -> Programs:
    """Improve the `open` programs to the `accuracy`, in at most `most` interior-point iterations each."""

    def step(model: QPModel, it: BatchIterate, barrier: Array, open_: Array):
        new = qp_step(batch.ocp, batch.u_before, model, it, barrier, open_)
        lower = jnp.where(open_, next_barrier(new.iterate, barrier, new.length, batch.tolerance), barrier)
        return new, lower, optimality_error(batch.ocp, batch.u_before, new.model, new.iterate)

    def improve(state: tuple[Programs, Array]) -> tuple[Programs, Array]:
        last, iteration = state
        open_ = last.open
        new, barrier, residual = compute_once(step)(last.model, last.iterate, last.barrier, open_)
        error = jnp.where(open_, worst(residual), last.error)
        infeasible = jnp.where(open_, new.infeasible, last.infeasible)
        left = jnp.where(open_, 1 - new.primal_length, 1.0) * last.left
        going = open_ & ~(error <= accuracy) & jnp.isfinite(error) & ~infeasible & (iteration + 1 < most)
        gains, num_steps = where(open_, new.gains, last.gains), last.num_steps + open_
        return Programs(
            new.model, new.iterate, barrier, gains, left, error, infeasible, going, num_steps
        ), iteration + 1

    return jax.lax.while_loop(lambda s: jnp.any(s[0].open), improve, (programs, jnp.asarray(0)))[0]
