"""Compute candidate speed profiles for a corner: nested bounds on a step that reduces the lateral error."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from driftjax.core import RESULTS

TOLERANCE = 1e-8  # on the projected gradient, relative to its size at the start
MAX_STEPS = 100
LENGTHS = 0.5 ** np.arange(12)  # trial step lengths, evaluated together


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


def _bounded_least_squares(f, start: Array, lower: Array, upper: Array):
    """Minimise |f|^2 / 2 in a box by projected Gauss-Newton (Bertsekas 1982, Eq. 12-20); J of f has full rank."""

    def gradient(x):
        value, pullback = jax.vjp(f, x)
        return 0.5 * jnp.sum(value**2), pullback(value)[0]

    def projected(x, g):
        return jnp.max(jnp.abs(x - jnp.clip(x - g, lower, upper)))

    def step(carry):
        x, _, count, _ = carry
        value, g = gradient(x)
        J = jax.jacfwd(f)(x)
        H = J.T @ J
        held = ((x <= lower) & (g > 0)) | ((x >= upper) & (g < 0))
        H = jnp.where(held[:, None] | held[None, :], jnp.diag(jnp.diagonal(H)), H)
        p = -jnp.linalg.solve(H, g)
        trials = jnp.clip(x + LENGTHS[:, None] * p, lower, upper)
        promised = LENGTHS * jnp.sum(jnp.where(held, 0.0, g * p)) + (trials - x) @ jnp.where(held, g, 0.0)
        values = jax.vmap(lambda y: gradient(y)[0])(trials)
        good = values <= value + 1e-4 * promised
        moved = jnp.any(good)
        x = jnp.where(moved, trials[jnp.argmax(good)], x)
        return x, projected(x, gradient(x)[1]), count + 1, ~moved

    first = jnp.clip(start, lower, upper)
    error = projected(first, gradient(first)[1])
    tolerance = TOLERANCE * jnp.maximum(1.0, jnp.max(jnp.abs(gradient(first)[1])))
    running = lambda c: (c[1] > tolerance) & (c[2] < MAX_STEPS) & ~c[3]
    x, error, count, stuck = jax.lax.while_loop(running, step, (first, error, jnp.asarray(0), jnp.asarray(False)))
    result = RESULTS.where(stuck, RESULTS.stalled, RESULTS.not_converged)  # pyright: ignore
    result = RESULTS.where(error <= tolerance, RESULTS.successful, result)  # pyright: ignore
    return x, error, count, RESULTS.where(jnp.isfinite(error), result, RESULTS.non_finite)  # pyright: ignore


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
        f = lambda gamma: residuals(gamma, V_origin, s, r_b * e, w1, w2)
        gamma, error, count, result = _bounded_least_squares(f, r_b * e, lower, upper)
        result = RESULTS.where(possible, result, RESULTS.infeasible)  # pyright: ignore[reportArgumentType]
        V = V_origin + gamma
        return gamma, V, jnp.sum(weight * V) / jnp.sum(weight), error, count, result

    gamma, V, V_ep, error, count, result = jax.vmap(candidate)(jnp.asarray(gamma_bounds))
    same = jnp.abs(V_ep[:, None] - V_ep[None, :]) < 1e-3
    distinct = ~jnp.any(jnp.tril(same, -1), axis=1)
    return SpeedSets(gamma, V, V_ep, distinct, error, count, result)
