"""Bounded minimisation by damped Newton steps, for functions given with gradient and curvature."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import cho_solve

from driftjax.core.bounded import Minimum
from driftjax.core.results import RESULTS

REACH = 1.0  # longest step of any variable
DAMPING, FEEBLEST, STRONGEST = 0.05, 1e-6, 1e6  # the first, the least, and the one beyond which no step helps
FALL, GROW, FAIL = 0.2, 4.0, 5.0  # factors of the damping: decrease as promised, much less, and none
CLAMPS = 3  # solutions of one step, each with the variables held that went beyond their limits in the one before


class _State(NamedTuple):
    x: Array
    value: Array
    gradient: Array
    curvature: Array
    trial: Array  # where to evaluate next
    promised: Array  # decrease there by the quadratic model
    damping: Array
    num_steps: Array  # -1 before the first evaluation


def _step(gradient: Array, curvature: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return a step (n,) in low <= 0 <= high that nearly minimises the quadratic model, and its predicted decrease."""
    held = ((low >= 0) & (gradient > 0)) | ((high <= 0) & (gradient < 0))
    step = jnp.zeros_like(gradient)
    for _ in range(CLAMPS):
        slope = gradient + curvature @ jnp.where(held, step, 0.0)
        matrix = jnp.where(held[:, None] | held, jnp.eye(held.size, dtype=step.dtype), curvature)
        full = -cho_solve((jnp.linalg.cholesky(matrix), True), jnp.where(held, 0.0, slope))
        full = jnp.where(held, step, full)
        step = jnp.clip(full, low, high)
        held = held | (step != full)
    return step, -gradient @ step - 0.5 * step @ curvature @ step


def _error(x: Array, gradient: Array, lower: Array, upper: Array) -> Array:
    """Return the largest element of the projected gradient."""
    return jnp.max(jnp.abs(x - jnp.clip(x - gradient, lower, upper)))


def _next(s: _State, evaluated: tuple[Array, Array, Array], lower: Array, upper: Array) -> _State:
    """Return the next solver state: accept the trial point if its value is lower, and choose the next trial point."""
    first = s.num_steps < 0
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(part)) for part in evaluated]))
    better = first | (finite & (evaluated[0] < s.value))
    share = (s.value - evaluated[0]) / s.promised
    change = jnp.where(share > 0.75, FALL, jnp.where(share < 0.25, GROW, 1.0))
    change = jnp.where(first, 1.0, jnp.where(better, change, FAIL))
    damping = jnp.maximum(change * s.damping, FEEBLEST)
    keep = lambda new, old: jnp.where(better, new, old)
    x, value, gradient, curvature = map(keep, (s.trial, *evaluated), (s.x, s.value, s.gradient, s.curvature))
    low, high = jnp.maximum(lower - x, -REACH), jnp.minimum(upper - x, REACH)
    step, promised = _step(gradient, curvature + damping * jnp.eye(x.size, dtype=x.dtype), low, high)
    trial = jnp.clip(x + step, lower, upper)
    return _State(x, value, gradient, curvature, trial, promised, damping, s.num_steps + 1)


def minimise_batch(
    evaluate: Callable[[Array], tuple[Array, Array, Array]],
    guess: Array,
    lower: Array,
    upper: Array,
    *,
    max_iterations: int = 30,
    tolerance: float = 1e-3,
) -> Minimum:
    """Return a local minimum with lower <= x <= upper (n,) from one start; its value never exceeds the start's.

    `evaluate(x)` returns value, gradient (n,) and a positive semi-definite approximation (n, n) of the Hessian. Steps
    are damped as by Levenberg and Marquardt (Nocedal and Wright 2006, Sec. 10.3), with the variables at bounds held
    where the gradient keeps them there (projected Newton, Bertsekas 1982). Variables should be of order 1.
    """

    def going(s: _State) -> Array:
        inside = (s.num_steps < max_iterations) & (s.damping < STRONGEST)
        return (s.num_steps < 0) | (
            inside & jnp.isfinite(s.value) & (_error(s.x, s.gradient, lower, upper) > tolerance)
        )

    x = jnp.clip(guess, lower, upper)
    none = jnp.full(x.shape, jnp.nan, x.dtype)  # before the first evaluation, which is taken whatever it is
    damping = jnp.full((), DAMPING, x.dtype)
    start = _State(x, none[0], none, jnp.diag(none), x, none[0], damping, jnp.array(-1))
    end = jax.lax.while_loop(going, lambda s: _next(s, evaluate(s.trial), lower, upper), start)
    error = _error(end.x, end.gradient, lower, upper)
    result = RESULTS.where(error <= tolerance, RESULTS.successful, RESULTS.not_converged)  # pyright: ignore
    finite = jnp.isfinite(end.value) & jnp.isfinite(error)
    result = RESULTS.where(finite, result, RESULTS.non_finite)  # pyright: ignore[reportArgumentType]
    return Minimum(end.x, end.value, error, end.num_steps, result)
