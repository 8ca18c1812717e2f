"""Solve the drift MPC of many closed-loop laps at once: batched solver, with a globalised solver as fallback."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from driftjax.control.drift_batch_ocp import to_batch_ocp
from driftjax.control.mpc import DriftOCP, Reference, along, solve_mpc, within_limits
from driftjax.parallel import vmap_batch
from driftjax.solve import BatchSolution, Options, solve_batch
from driftjax.vehicle import SingleTrack

MIN_BATCH = 16  # the batched solver is no faster below this size
ATTEMPTS = (1.0, 10.0)  # times the first barrier: a larger one often solves what stalls at the limits


class MPCProblem(NamedTuple):
    """One drift MPC problem with the arguments of `solve_mpc`, all SI."""

    x: Float[Array, " 5"]  # V, beta, r, e, theta
    previous: Float[Array, " 2"]  # last command
    lagged_input: Float[Array, " 2"]  # actuator outputs
    reference: Reference
    X: Float[Array, "N+1 5"]  # guess
    U: Float[Array, "N 2"]
    options: Options


class MPCResult(NamedTuple):
    """Solution of one drift MPC problem, SI."""

    X: Float[Array, "N+1 5"]
    U: Float[Array, "N 2"]
    kkt: Array  # scaled residual
    violation: Array
    num_steps: Array


def acceptable(answer: MPCResult, options: Options) -> Array:
    """Return whether each solution meets the accepted multiple of its tolerance; False on NaN."""
    return jnp.maximum(answer.kkt, answer.violation) <= options.implicit * options.tolerance


def solve_with_fallback(ocp: DriftOCP, problem: MPCProblem) -> MPCResult:
    """Solve one problem by `solve_mpc`; if not acceptable, repeat it, starting further from the limits."""

    def attempt(last: MPCResult, far: Array) -> tuple[MPCResult, None]:
        done, given = acceptable(last, problem.options), problem.options

        def again() -> MPCResult:  # a batch may hold solved entries, which must not iterate
            steps = jnp.where(done, 0, given.max_steps)
            options = Options(given.tolerance, far * given.barrier, steps, given.implicit)
            found = solve_mpc(ocp, *problem._replace(options=options))
            num_steps = last.num_steps + found.plan.num_steps
            return MPCResult(found.X, found.U, found.plan.kkt, found.plan.violation, num_steps)

        return jax.lax.cond(done, lambda: last, again), None

    none = jnp.full_like(problem.options.tolerance, jnp.inf)
    first = MPCResult(problem.X, problem.U, none, none, jnp.zeros_like(problem.options.max_steps))
    return jax.lax.scan(attempt, first, jnp.asarray(ATTEMPTS))[0]


def solve_mpc_batch(ocp: DriftOCP, problem: MPCProblem, needed: Bool[Array, " batch"]) -> MPCResult:
    """Solve a batch (leading axis): large single-track batches in one batched solve, others by `solve_with_fallback`.

    Problems that the batched solver leaves unacceptable are solved by `solve_with_fallback`, one after the other.
    Entries not `needed` cost nothing and are returned unsolved.
    """
    if len(needed) < MIN_BATCH or not isinstance(ocp.nominal, SingleTrack):
        return vmap_batch(solve_with_fallback)(ocp, problem)
    found = _batched(ocp, problem, needed)
    left = needed & ~acceptable(found, problem.options)

    def again(entry: tuple[DriftOCP, MPCProblem, MPCResult, Array]) -> MPCResult:
        ocp, problem, found, left = entry
        return jax.lax.cond(left, lambda: solve_with_fallback(ocp, problem), lambda: found)

    return jax.lax.cond(jnp.any(left), lambda: jax.lax.map(again, (ocp, problem, found, left)), lambda: found)


def _batched(ocp: DriftOCP, problem: MPCProblem, needed: Array) -> MPCResult:
    """Solve the batch by the batched solver, forces in units of the car's weight."""
    scale, options = jax.vmap(lambda one: one.u_scale)(ocp), problem.options  # (batch, 2)
    U = jax.vmap(within_limits)(ocp, problem.U, problem.previous)
    lagged_input = jax.vmap(along)(ocp, problem.lagged_input, U)
    guess = jnp.concatenate([problem.X, lagged_input / scale[:, None]], axis=2)
    last = lambda a: jnp.transpose(a, (2, 1, 0))  # move the batch axis to the end, and back
    plans: BatchSolution = solve_batch(
        to_batch_ocp(ocp, scale[:, 1]),
        jnp.concatenate([problem.x, problem.lagged_input / scale], axis=1).T,
        (problem.previous / scale).T,
        jax.tree.map(lambda a: a.T, problem.reference),
        last(guess),
        last(U / scale[:, None]),
        Options(options.tolerance, options.barrier, options.max_steps),
        needed,
    )
    # the interior point ends a rounding error inside the limits; clipping only takes that rounding away
    inputs = last(plans.U) * scale[:, None]
    inputs = jax.vmap(lambda ocp, U, u: within_limits(ocp, U, u, share=0.0))(ocp, inputs, problem.previous)
    num_steps = jnp.where(needed, plans.num_steps, 0).astype(int)
    return MPCResult(last(plans.X[:5]), inputs, plans.kkt, plans.violation, num_steps)
