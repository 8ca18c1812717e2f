"""Real-time iteration in two halves (Diehl et al. 2005, Sec. 3): prepare a program, then solve it from a measurement.

`prepare` linearises at a guess, before the state is measured; `respond` solves the program from the state, touching
stored matrices only; `problem_error` says afterwards how near to optimal the answer is for the nonlinear problem.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree

from driftjax.solve.batch_conditions import BatchIterate, OptimalityError, QPModel
from driftjax.solve.batch_newton import no_gains
from driftjax.solve.batch_ocp import AbstractBatchOCP, Components
from driftjax.solve.batch_program import (
    LAST_STEPS,
    BatchData,
    Programs,
    batch_data,
    first_iterate,
    qp_model,
    solve_programs,
    with_curvature,
)
from driftjax.solve.component_derivatives import dot, total
from driftjax.solve.ocp import Options


class Preparation(NamedTuple):
    """Quadratic programs of a batch about a guess, and the data of their problems that change from step to step."""

    u_before: Components
    params: tuple[PyTree, PyTree]  # of the stages and of the end
    tolerance: Array
    model: QPModel
    iterate: BatchIterate
    barrier: Array

    def batch(self, ocp: AbstractBatchOCP) -> BatchData:
        """Return the data of the problems."""
        return BatchData(ocp, *self.params, self.u_before, self.tolerance, jnp.ones_like(self.barrier, jnp.int32))


class Response(NamedTuple):
    """Solutions of the programs of a preparation."""

    X: Float[Array, "nx N+1 batch"]
    U: Float[Array, "nu N batch"]
    error: Float[Array, " batch"]  # worst of optimality error and violation, of the program
    num_steps: Array  # interior-point iterations (batch,)
    infeasible: Array  # whether the program was proven to have no feasible point (batch,)
    iterate: BatchIterate


def prepare(
    ocp: AbstractBatchOCP,
    u_before: Float[Array, "nu batch"],
    params: PyTree,
    X: Float[Array, "nx N+1 batch"],
    U: Float[Array, "nu N batch"],
    options: Options,
) -> Preparation:
    """Linearise at the guess `X`, `U`, whose first state is the one expected; arguments as for `solve_batch`."""
    like = U[0][0]
    batch = batch_data(ocp, u_before, params, like, options)
    barrier = jnp.broadcast_to(jnp.asarray(options.barrier, like.dtype), like.shape)
    it = first_iterate(batch, [x[0] for x in X], list(X), list(U), barrier)
    model, *_ = qp_model(batch, it, ocp.local_expansion([x[:-1] for x in it.X], it.U, batch.stages))
    straight = [[None for _ in row] for row in model.H]  # multipliers begin at 0: a Gauss-Newton step
    whole = with_curvature(model, straight, it.U[0])
    return Preparation(batch.u_before, batch.rows, batch.tolerance, whole, it, barrier)


def respond(ocp: AbstractBatchOCP, prepared: Preparation, x0: Float[Array, "nx batch"]) -> Response:
    """Solve the programs from the measured state `x0`, to the tolerance of the preparation.

    Where `x0` is the first state of the guess, the response is the real-time iteration of `solve_batch`; elsewhere it
    differs from that in the second order of their distance, since the first stage is linearised at the guess.
    """
    batch, barrier = prepared.batch(ocp), prepared.barrier
    model, it = _from_state(prepared.model, prepared.iterate, list(x0))
    none, gains = jnp.zeros_like(barrier), no_gains(*it[:2])
    never, count = jnp.zeros_like(barrier, bool), jnp.zeros_like(barrier, jnp.int32)
    start = Programs(model, it, barrier, gains, none + 1, none + jnp.inf, never, ~never, count)
    end = solve_programs(batch, start, batch.tolerance, jnp.full_like(count, LAST_STEPS))
    X, U = jnp.stack(end.iterate.X), jnp.stack(end.iterate.U)
    return Response(X, U, end.error, end.num_steps, end.infeasible, end.iterate)


def _from_state(model: QPModel, it: BatchIterate, x0: Components) -> tuple[QPModel, BatchIterate]:
    """Move the first state, and the model with it: all of it is affine in the step."""
    step = [jnp.zeros_like(it.U[0]).at[0].set(new - x[0]) for new, x in zip(x0, it.X, strict=True)]
    moved = lambda values, rows: [total((v, dot(row[: len(step)], step))) for v, row in zip(values, rows, strict=True)]
    model = model._replace(c=moved(model.c, model.M), h=moved(model.h, model.H), g=moved(model.g, model.G))
    return model, it._replace(X=[x.at[0].set(new) for x, new in zip(it.X, x0, strict=True)])


def problem_error(ocp: AbstractBatchOCP, prepared: Preparation, response: Response) -> OptimalityError:
    """Return the residuals of the nonlinear problem at the response, which costs another linearisation."""
    batch, it = prepared.batch(ocp), response.iterate
    return qp_model(batch, it, ocp.local_expansion([x[:-1] for x in it.X], it.U, batch.stages))[2]
