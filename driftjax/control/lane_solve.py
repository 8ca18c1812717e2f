"""The drift MPC of many closed-loop laps at once: batched solves, and the safeguarded solver for lanes they leave."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from driftjax.control.lanes import lanes_of
from driftjax.control.mpc import DriftOCP, Reference, along, solve_mpc, within_limits
from driftjax.parallel import vmap_batch
from driftjax.solve import LanePlans, Options, solve_lanes
from driftjax.vehicle import SingleTrack

FEW_LANES = 16  # below so many the batched solver gains nothing
ATTEMPTS = (1.0, 10.0)  # times the first barrier: what jams at its limits with a small one is often solved with a large


class Posed(NamedTuple):
    """One problem of the drift MPC, as `solve_mpc` takes it, all SI."""

    x: Float[Array, " 5"]  # V, beta, r, e, theta
    previous: Float[Array, " 2"]  # last command
    reached: Float[Array, " 2"]  # what actuators have made of the commands
    reference: Reference
    X: Float[Array, "N+1 5"]  # guess
    U: Float[Array, "N 2"]
    options: Options


class Answer(NamedTuple):
    """What came of it, SI."""

    X: Float[Array, "N+1 5"]
    U: Float[Array, "N 2"]
    kkt: Array  # scaled residual
    violation: Array
    num_steps: Array


def acceptable(answer: Answer, options: Options) -> Array:
    """Whether an answer, or each of a batch, is as near to optimal as `options` accept; False on NaN."""
    return jnp.maximum(answer.kkt, answer.violation) <= options.implicit * options.tolerance


def safeguarded(ocp: DriftOCP, posed: Posed) -> Answer:
    """One problem by `solve_mpc`; where the answer is not acceptable, once more, first further from the limits."""

    def attempt(last: Answer, far: Array) -> tuple[Answer, None]:
        done, given = acceptable(last, posed.options), posed.options

        def again() -> Answer:  # a batch comes here with lanes that are done, which must not iterate
            steps = jnp.where(done, 0, given.max_steps)
            options = Options(given.tolerance, far * given.barrier, steps, given.implicit)
            found = solve_mpc(ocp, *posed._replace(options=options))
            num_steps = last.num_steps + found.plan.num_steps
            return Answer(found.X, found.U, found.plan.kkt, found.plan.violation, num_steps)

        return jax.lax.cond(done, lambda: last, again), None

    none = jnp.full_like(posed.options.tolerance, jnp.inf)
    first = Answer(posed.X, posed.U, none, none, jnp.zeros_like(posed.options.max_steps))
    return jax.lax.scan(attempt, first, jnp.asarray(ATTEMPTS))[0]


def answers(ocp: DriftOCP, posed: Posed, needed: Bool[Array, " batch"]) -> Answer:
    """All lanes (leading axis): many of a single track at once, few or other cars by the safeguarded solver alone.

    Of many, those whose answer by the batched solver is not acceptable go through the safeguarded one, one after the
    other. Lanes not `needed` cost nothing and come back unsolved.
    """
    if len(needed) < FEW_LANES or not isinstance(ocp.nominal, SingleTrack):
        return vmap_batch(safeguarded)(ocp, posed)
    found = _batched(ocp, posed, needed)
    left = needed & ~acceptable(found, posed.options)

    def again(lane: tuple[DriftOCP, Posed, Answer, Array]) -> Answer:
        ocp, posed, found, left = lane
        return jax.lax.cond(left, lambda: safeguarded(ocp, posed), lambda: found)

    return jax.lax.cond(jnp.any(left), lambda: jax.lax.map(again, (ocp, posed, found, left)), lambda: found)


def _batched(ocp: DriftOCP, posed: Posed, needed: Array) -> Answer:
    """All lanes by the batched solver, forces in units of the car's weight."""
    scale, options = jax.vmap(lambda one: one.u_scale)(ocp), posed.options  # (batch, 2)
    U = jax.vmap(within_limits)(ocp, posed.U, posed.previous)
    reached = jax.vmap(along)(ocp, posed.reached, U)
    guess = jnp.concatenate([posed.X, reached / scale[:, None]], axis=2)
    last = lambda a: jnp.transpose(a, (2, 1, 0))  # the batch, to and fro
    plans: LanePlans = solve_lanes(
        lanes_of(ocp, scale[:, 1]),
        jnp.concatenate([posed.x, posed.reached / scale], axis=1).T,
        (posed.previous / scale).T,
        jax.tree.map(lambda a: a.T, posed.reference),
        last(guess),
        last(U / scale[:, None]),
        Options(options.tolerance, options.barrier, options.max_steps),
        needed,
    )
    # the interior point ends a rounding error inside the limits; clipping only takes that rounding away
    inputs = last(plans.U) * scale[:, None]
    inputs = jax.vmap(lambda ocp, U, u: within_limits(ocp, U, u, share=0.0))(ocp, inputs, posed.previous)
    num_steps = jnp.where(needed, plans.num_steps, 0).astype(int)
    return Answer(last(plans.X[:5]), inputs, plans.kkt, plans.violation, num_steps)
