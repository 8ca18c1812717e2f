"""Solve the drift MPC: one problem, or a batch of them on the leading axis."""

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


class MPCProblem(NamedTuple):
    """One drift MPC problem, all SI."""

    x: Float[Array, " 5"]  # V, beta, r, e, theta
    previous: Float[Array, " 2"]  # last command
    lagged_input: Float[Array, " 2"]  # actuator outputs
    reference: Reference
    X: Float[Array, "N+1 5"]  # guess
    U: Float[Array, "N 2"]
    options: Options


class MPCSolution(eqx.Module):
    """Solution in SI units: the command to apply, the plan behind it, and its convergence."""

    u: Control  # first input of the plan
    X: Float[Array, "N+1 5"]  # predicted V, beta, r, e, theta
    U: Float[Array, "N 2"]  # planned delta, Fxr
    plan: Solution  # in the units of the solver, with its residuals


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
    scale = ocp.u_scale  # (batch, 2)
    U = _over_batch(within_limits, ocp, problem.U, problem.previous)
    lagged_input = _over_batch(along, ocp, problem.lagged_input, U)
    guess = jnp.concatenate([problem.X, lagged_input / scale[:, None]], axis=2)
    last = lambda a: jnp.transpose(a, (2, 1, 0))  # move the batch axis to the end
    plans = solve_batch(
        to_batch_ocp(ocp, scale[:, 1]),
        jnp.concatenate([problem.x, problem.lagged_input / scale], axis=1).T,
        (problem.previous / scale).T,
        jax.tree.map(lambda a: a.T, problem.reference),
        last(guess),
        last(U / scale[:, None]),
        problem.options,
        needed,
    )
    plan = plain(plans)
    # the interior point ends a rounding error inside the limits; clipping only takes that rounding away
    clip = lambda ocp, U, previous: within_limits(ocp, U, previous, share=0.0)
    inputs = _over_batch(clip, ocp, plan.U * scale[:, None], problem.previous)
    return MPCSolution(Control(inputs[:, 0, 0], inputs[:, 0, 1]), plan.X[..., :5], inputs, plan)


def _over_batch(function: Callable[..., Array], ocp: DriftOCP, *arrays: Array) -> Array:
    """Map a function of one problem and its arrays over the batch."""
    if len(ocp.weight) == 1:  # one for all
        return jax.vmap(partial(function, jax.tree.map(lambda a: a[0], ocp)))(*arrays)
    return jax.vmap(function)(ocp, *arrays)
