"""Bounded minimisation, L-BFGS-B. The only module that knows jaxopt."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxopt
from jax import Array

from driftjax.core import RESULTS


class Minimum(eqx.Module):
    """Where a bounded minimisation ended."""

    x: Array  # (n,)
    value: Array
    error: Array  # largest projected gradient
    num_steps: Array
    result: RESULTS


def minimise(
    objective: Callable[..., Array],
    guess: Array,
    lower: Array,
    upper: Array,
    *args: Any,
    max_iterations: int = 30,
    tolerance: float = 1e-3,
) -> Minimum:
    """Local minimum of `objective(x, *args)` with lower <= x <= upper (Byrd et al. 1995), one start; vmap for many."""
    both = jax.value_and_grad(objective)
    # c2 disables the curvature condition, which leaves Armijo's rule at ONE evaluation per trial: under vmap
    # every trial of the default search costs several evaluations for all starts.
    search = jaxopt.BacktrackingLineSearch(
        fun=both, value_and_grad=True, maxiter=12, condition="wolfe", c2=1e12, decrease_factor=0.4, jit=True
    )
    solver = jaxopt.LBFGSB(
        fun=both,
        value_and_grad=True,
        maxiter=max_iterations,
        tol=tolerance,
        linesearch=search,  # pyright: ignore[reportArgumentType]
        linesearch_init="max",
        stop_if_linesearch_fails=True,
        implicit_diff=False,
        history_size=8,
        jit=True,
    )
    end = solver.run(jnp.clip(guess, lower, upper), (lower, upper), *args)
    x, state = end.params, end.state
    finite = jnp.isfinite(state.value) & jnp.all(jnp.isfinite(x))
    converged, failed = state.error <= tolerance, ~finite
    result = RESULTS.where(converged, RESULTS.successful, RESULTS.not_converged)  # pyright: ignore
    result = RESULTS.where(failed, RESULTS.non_finite, result)  # pyright: ignore[reportArgumentType]
    return Minimum(x, state.value, state.error, state.iter_num, result)
