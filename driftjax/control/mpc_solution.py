"""Solve the drift MPC: one problem, or a batch of them on the leading axis, to convergence or in two halves."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from driftjax.control.drift_batch_ocp import to_batch_ocp
from driftjax.control.mpc import DriftOCP, Reference, along, within_limits
from driftjax.core import Control
from driftjax.solve import Options, Solution, plain, solve_batch
from driftjax.solve.batch_conditions import OptimalityError
from driftjax.solve.batch_ocp import AbstractBatchOCP
from driftjax.solve.real_time import Preparation, Response, prepare, problem_error, respond


class MPCProblem(NamedTuple):
    """One drift MPC problem, all SI."""

    x: Float[Array, " 5"]  # V, beta, r, e, theta
    previous: Float[Array, " 2"]  # last command
    lagged_input: Float[Array, " 2"]  # actuator outputs
    reference: Reference
    X: Float[Array, "N+1 5"]  # guess
    U: Float[Array, "N 2"]
    options: Options


class MPCPlan(eqx.Module):
    """Plan in SI units, and the command to apply."""

    u: Control  # first input of the plan
    X: Float[Array, "N+1 5"]  # predicted V, beta, r, e, theta
    U: Float[Array, "N 2"]  # planned delta, Fxr


class MPCSolution(MPCPlan):
    """Solution of the drift MPC, and its convergence."""

    plan: Solution  # in the units of the solver, with its residuals


class MPCResponse(MPCPlan):
    """Answer of a real-time iteration."""

    response: Response  # of the solver, the batch on the last axis, with the error of its program


def acceptable(solution: MPCSolution, options: Options) -> Array:
    """Return whether each solution meets the accepted multiple of its tolerance; False on NaN."""
    plan = solution.plan
    return jnp.maximum(plan.kkt, plan.violation) <= options.implicit * options.tolerance


def solve_mpc(
    ocp: DriftOCP,
    x: Float[Array, " 5"],
    previous: Float[Array, " 2"],
    lagged_input: Float[Array, " 2"],
    reference: Reference,
    X: Float[Array, "N+1 5"],
    U: Float[Array, "N 2"],
    options: Options,
) -> MPCSolution:
    """Solve Eq. 10 from `x` (V, beta, r, e, theta), command `previous`, actuator outputs and guess `X`, `U`, all SI."""
    one = (ocp, MPCProblem(x, previous, lagged_input, reference, X, U, options))
    batch = jax.tree.map(lambda a: jnp.asarray(a)[None] if eqx.is_array_like(a) else a, one)
    return jax.tree.map(lambda a: a[0], solve_mpc_batch(*batch))


def solve_mpc_batch(ocp: DriftOCP, problem: MPCProblem, needed: Bool[Array, " batch"] | None = None) -> MPCSolution:
    """Solve a batch (leading axis, of size 1 in `ocp` if shared); entries not `needed` cost nothing, stay unsolved."""
    by_component, u_before, reference, X, U = _guess(ocp, problem)
    x0 = _state(ocp, problem.x, problem.lagged_input)
    plan = plain(solve_batch(by_component, x0, u_before, reference, X, U, problem.options, needed))
    inputs = _within(ocp, plan.U, problem.previous)
    return MPCSolution(Control(inputs[:, 0, 0], inputs[:, 0, 1]), plan.X[..., :5], inputs, plan)


def prepare_mpc(ocp: DriftOCP, problem: MPCProblem) -> Preparation:
    """Prepare a batch of real-time iterations about the guess, from the state that is expected."""
    by_component, u_before, reference, X, U = _guess(ocp, problem)
    expected = X.at[:, 0].set(_state(ocp, problem.x, problem.lagged_input))
    return prepare(by_component, u_before, reference, expected, U, problem.options)


def respond_mpc(
    ocp: DriftOCP,
    prepared: Preparation,
    x: Float[Array, "batch 5"],
    previous: Float[Array, "batch 2"],
    lagged_input: Float[Array, "batch 2"],
) -> MPCResponse:
    """Solve the prepared programs from a measured state, the last command and the actuator outputs, all SI."""
    response = respond(to_batch_ocp(ocp, ocp.u_scale[:, 1]), prepared, _state(ocp, x, lagged_input))
    X, U = (jnp.transpose(a, (2, 1, 0)) for a in (response.X, response.U))
    inputs = _within(ocp, U, previous)
    return MPCResponse(Control(inputs[:, 0, 0], inputs[:, 0, 1]), X[..., :5], inputs, response)


def judge_mpc(ocp: DriftOCP, prepared: Preparation, answer: MPCResponse) -> OptimalityError:
    """Return the residuals of the nonlinear problem at an answer, in the units of the solver."""
    return problem_error(to_batch_ocp(ocp, ocp.u_scale[:, 1]), prepared, answer.response)


def _guess(ocp: DriftOCP, problem: MPCProblem) -> tuple[AbstractBatchOCP, Array, Reference, Array, Array]:
    """Return the arguments of the solver, the batch on the last axis: problem, last command, reference and guess."""
    scale = ocp.u_scale  # (batch, 2)
    U = _over_batch(within_limits, ocp, problem.U, problem.previous)
    lagged_input = _over_batch(along, ocp, problem.lagged_input, U)
    X = jnp.concatenate([problem.X, lagged_input / scale[:, None]], axis=2)
    last = lambda a: jnp.transpose(a, (2, 1, 0))  # move the batch axis to the end
    reference = jax.tree.map(lambda a: a.T, problem.reference)
    by_component = to_batch_ocp(ocp, scale[:, 1])
    return by_component, (problem.previous / scale).T, reference, last(X), last(U / scale[:, None])


def _state(ocp: DriftOCP, x: Array, lagged_input: Array) -> Array:
    """Return the solver's state (nx, batch)."""
    return jnp.concatenate([x, lagged_input / ocp.u_scale], axis=1).T


def _within(ocp: DriftOCP, U: Array, previous: Array) -> Array:
    """Return the solver's inputs (batch, N, 2) in SI; clipping only takes away the interior point's rounding errors."""
    clip = lambda ocp, U, previous: within_limits(ocp, U, previous, share=0.0)
    return _over_batch(clip, ocp, U * ocp.u_scale[:, None], previous)


def _over_batch(function: Callable[..., Array], ocp: DriftOCP, *arrays: Array) -> Array:
    """Map a function of one problem and its arrays over the batch."""
    if len(ocp.weight) == 1:  # one for all
        return jax.vmap(partial(function, jax.tree.map(lambda a: a[0], ocp)))(*arrays)
    return jax.vmap(function)(ocp, *arrays)
