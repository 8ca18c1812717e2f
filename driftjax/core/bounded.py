"""Bounded minimisation of smooth functions of a few variables; the only module that imports jaxopt.

jaxopt is no longer developed: it is pinned; a replacement of it replaces this module only.
"""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from driftjax.core.results import RESULTS

WORST = 1e30  # takes the place of a value that is not finite, so that the line search rejects it


def _solver(function: Callable, **options: Any) -> Any:
    """Return the L-BFGS-B of jaxopt, loaded here since it loads SciPy and, where installed, numba: a second or two."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
        from jaxopt import LBFGSB
    return LBFGSB(function, linesearch_init="max", stop_if_linesearch_fails=True, **options)


class Minimum(eqx.Module):
    """End point of a bounded minimisation."""

    x: Float[Array, " n"]
    value: Float[Array, ""]
    error: Float[Array, ""]  # largest projected gradient
    num_steps: Int[Array, ""]
    result: RESULTS


def minimise_within(
    function: Callable[..., Array],
    start: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    *args: Any,
    tolerance: float,
    max_steps: int,
) -> Minimum:
    """Return a local minimum of `function(x, *args)` with lower <= x <= upper, by L-BFGS-B with automatic gradient.

    Method: Byrd, Lu, Nocedal and Zhu 1995, Algorithm L-BFGS-B. Variables should be of order 1. Points at which value
    or gradient are not finite are never taken. `result` is `successful` where the largest projected gradient is at
    most `tolerance`, `infeasible` where bounds are the wrong way round, `non_finite` where the start has no value,
    `stalled` where the line search fails and else `not_converged`.
    """

    @jax.jit  # traced once, where the solver calls it in several places
    def evaluate(x: Array, *args: Any) -> tuple[Array, Array]:
        value, gradient = jax.value_and_grad(function)(x, *args)
        finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))
        return jnp.where(finite, value, WORST), jnp.where(finite, gradient, 0.0)

    solver = _solver(evaluate, value_and_grad=True, maxiter=max_steps, tol=tolerance)
    x, bounds = jnp.clip(start, lower, upper), (lower, upper)
    first = jax.tree.map(jnp.asarray, solver.init_state(x, bounds, *args))
    running = lambda x, s: (s.error > tolerance) & (s.iter_num < max_steps) & ~s.failed_linesearch
    # as `solver.run`, which has the step twice in its program and so takes half as long again to compile
    step = lambda pair: tuple(solver.update(*pair, bounds, *args))
    x, state = jax.lax.while_loop(lambda pair: running(*pair), step, (x, first))
    result = RESULTS.where(state.failed_linesearch, RESULTS.stalled, RESULTS.not_converged)  # pyright: ignore
    result = RESULTS.where(state.error <= tolerance, RESULTS.successful, result)  # pyright: ignore
    result = RESULTS.where(state.value < WORST, result, RESULTS.non_finite)  # pyright: ignore
    result = RESULTS.where(jnp.all(lower <= upper), result, RESULTS.infeasible)  # pyright: ignore
    return Minimum(x, state.value, state.error, state.iter_num, result)
