"""Fixed-step integration of pytrees."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

T = TypeVar("T")


def axpy(a: ArrayLike, x: T, y: T) -> T:
    """Return a x + y, leaf by leaf."""
    return jax.tree.map(lambda p, q: a * p + q, x, y)


def rk4_step(f: Callable[[T], T], x: T, dt: float | Array) -> T:
    """Return the state after one step of the classical Runge-Kutta method of order 4, x_dot = f(x), step `dt` [s]."""
    k1 = f(x)
    k2 = f(axpy(dt / 2, k1, x))
    k3 = f(axpy(dt / 2, k2, x))
    k4 = f(axpy(dt, k3, x))
    return jax.tree.map(lambda x, a, b, c, d: x + dt / 6 * (a + 2 * b + 2 * c + d), x, k1, k2, k3, k4)


class Tableau(NamedTuple):
    """Explicit Runge-Kutta method in which each slope needs only the one before."""

    into: np.ndarray  # distance along the previous slope at which each is evaluated, in steps
    weights: np.ndarray  # of the slopes in the step


RK4 = Tableau(np.array([0.0, 0.5, 0.5, 1.0]), np.array([1.0, 2.0, 2.0, 1.0]) / 6)  # classical, order 4
HEUN = Tableau(np.array([0.0, 1.0]), np.array([0.5, 0.5]))  # order 2


def rk4_loop(f: Callable[[Array, Any], Array], x: Array, dt: float | Array, along: Any = None) -> Array:
    """Return the step of `rk4_step` for x_dot = f(x, p), computed in a loop; `along` holds one row of p per slope.

    A quarter of the program, and so of what derivatives of it take to compile; XLA cannot then do the first slopes
    again for each use of the later ones either, which in second derivatives costs most of the time.
    """
    stages = (*map(jnp.asarray, RK4), along)

    def stage(carry, now):
        k, end = carry
        into, weight, p = now
        k = f(x + dt * into.astype(x.dtype) * k, p)
        return (k, end + dt * weight.astype(x.dtype) * k), None

    return jax.lax.scan(stage, (jnp.zeros_like(x), x), stages)[0][1]


def _decay_over_step(lag: Array, dt: Array) -> Array:
    """Return exp(-dt / lag), 0 for a lag of 0; its derivatives are finite."""
    slow = lag > 1e-6 * dt
    return jnp.where(slow, jnp.exp(-dt / jnp.where(slow, lag, dt)), 0.0)


def lag_step(value: Array, target: Array, lag: Array, dt: Array) -> tuple[Array, Array]:
    """Return mean and end value, over a step `dt` [s], of a first-order lag `lag` [s] towards `target`.

    Exact for a constant target over the step; a lag of 0 gives the target itself, with the derivative of a small lag.
    """
    decay = _decay_over_step(lag, dt)
    mean = (1 - decay) * lag / dt
    return target + (value - target) * mean, target + (value - target) * decay


def markov_step(last: Array, kick: Array, decay: Array) -> Array:
    """Return the next value of a stationary first-order Gauss-Markov process; `kick` has its standard deviation.

    `decay` is exp(-dt / correlation time).
    """
    return decay * last + jnp.sqrt(1 - decay**2) * kick


def lag_slope(lag: Array, dt: Array) -> Array:
    """Return half the rise over a step `dt` [s] of the straight line with the first moment of exp(-t / `lag`).

    The line through the mean (`lag_step` of 1 towards 0) with this slope acts on an integrator as the exponential
    does, up to third order in the step; 0 for a lag of 0.
    """
    decay = _decay_over_step(lag, dt)
    q = lag / dt
    return 6 * q**2 * (1 - decay) - 3 * q * (1 + decay)
