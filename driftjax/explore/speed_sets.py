"""Compute candidate speed profiles for a corner: nested bounds on a step that reduces the lateral error."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from driftjax.core import RESULTS
from driftjax.core.bounded_newton import minimise_batch

TOLERANCE = 1e-7  # on the projected gradient, relative to its size at the start; values round at 1.5e-8 of it
MAX_STEPS = 100


class SpeedSets(eqx.Module):
    """One candidate per pair of bounds (K), at the N points of the path."""

    gamma: Array  # (K, N) speed increment [m/s]
    V: Array  # (K, N) new speed [m/s]
    V_ep: Array  # (K,) its mean over the drift section, the speed to explore [m/s]
    distinct: Array  # (K,) false where an earlier candidate has the same V_ep to a millimetre per second
    error: Array  # (K,) largest remaining projected gradient [m/s]
    num_steps: Array  # (K,)
    result: RESULTS  # (K,) `infeasible` where a lower bound or limit exceeds the upper one


def residuals(gamma: Array, V: Array, s: Array, target: Array, w1: Array, w2: Array) -> Array:
    """Return the residuals (2N - 2,) of the V-sets (Wu et al. 2025, Sec. III-B), in a physically consistent reading.

    sqrt(w1) (phi_k - phi_{k-1}) / (s_k - s_{k-1}) for k = 3..N with the slope phi_k = arctan(d(V + gamma) / ds) of
    the speed over the path, then sqrt(w2) (gamma - target) with the target r_b e. The arctan of a slope in 1/s is
    the paper's.
    """
    step = jnp.diff(s)
    slope = jnp.arctan(jnp.diff(V + gamma) / step)
    return jnp.concatenate([jnp.sqrt(w1) * jnp.diff(slope) / step[1:], jnp.sqrt(w2) * (gamma - target)])


def _expansion(residuals: Callable[[Array], Array], unit: Array, x: Array) -> tuple[Array, Array, Array]:
    """Return half the sum of squares over `unit`, its gradient and its Gauss-Newton curvature."""
    f, J = residuals(x), jax.jacfwd(residuals)(x)
    return 0.5 * f @ f / unit, J.T @ f / unit, J.T @ J / unit


def v_sets(
    V_origin: Array,
    s: Array,
    r_b: Array,
    e: Array,
    *,
    w1: ArrayLike,
    w2: ArrayLike,
    gamma_bounds: Array,
    V_min: ArrayLike,
    V_max: ArrayLike,
    section: Array | None = None,
) -> SpeedSets:
    """Compute candidate speeds of a corner planned at `V_origin` (N,) [m/s] at arc length `s` (N,) [m], ascending.

    `r_b` (N,) [rad/s] is the planned yaw rate, `e` (N,) [m] the measured lateral error, left positive: R = V / r, so
    that a car inside a left turn (e > 0) is moved outwards by gamma towards r_b e > 0. Each pair of `gamma_bounds` (K,
    2) [m/s] gives one candidate. The speed limits, scalars or (N,), take precedence: bounds are clipped to V_min <= V
    <= V_max. `section` (N,) marks the drifting points (all of them, if None).
    """
    weight = jnp.ones_like(V_origin) if section is None else section.astype(V_origin.dtype)
    w1, w2, V_min, V_max = (jnp.asarray(value) for value in (w1, w2, V_min, V_max))

    def candidate(bounds: Array):
        lower, upper = (jnp.clip(bound, V_min - V_origin, V_max - V_origin) for bound in bounds)
        possible = jnp.all((V_min <= V_max) & (lower <= upper))
        f, start = lambda gamma: residuals(gamma, V_origin, s, r_b * e, w1, w2), jnp.clip(r_b * e, lower, upper)
        unit = jnp.maximum(1.0, jnp.max(jnp.abs(jax.vjp(f, start)[1](f(start))[0])))
        evaluate = lambda x: _expansion(f, unit, x)
        end = minimise_batch(evaluate, start, lower, upper, max_iterations=MAX_STEPS, tolerance=TOLERANCE)
        result = RESULTS.where(possible, end.result, RESULTS.infeasible)  # pyright: ignore[reportArgumentType]
        V = V_origin + end.x
        return end.x, V, jnp.sum(weight * V) / jnp.sum(weight), unit * end.error, end.num_steps, result

    gamma, V, V_ep, error, count, result = jax.vmap(candidate)(jnp.asarray(gamma_bounds))
    same = jnp.abs(V_ep[:, None] - V_ep[None, :]) < 1e-3
    distinct = ~jnp.any(jnp.tril(same, -1), axis=1)
    return SpeedSets(gamma, V, V_ep, distinct, error, count, result)
