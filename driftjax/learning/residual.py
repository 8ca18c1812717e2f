"""Compute residuals of a lap: rows (z, d) for the GP."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from driftjax.core import Control, State, features, lag_step, rk4_step
from driftjax.sim import Trace
from driftjax.vehicle import AnyCar, Extended, SingleTrack

WINDOW = 5  # samples of the local parabola; centred, so that it delays nothing
# Savitzky and Golay 1964: value at the middle of the least-squares parabola through five even samples
SMOOTH = (-3 / 35, 12 / 35, 17 / 35, 12 / 35, -3 / 35)
LAG_STEPS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0])  # time constants tried, in control steps
RIDGE, TINY = 1e-6, 1e-12  # keep the regression and its logarithm finite where a lap has no rows
SWEEPS = 2  # fixed-point corrections of the residual; each gains a factor dt times the model's rate


def smooth(values: Float[Array, " T"]) -> Float[Array, " T"]:
    """Smooth by a centred parabola through five samples; the two samples at either end are unchanged."""
    num = values.shape[0] - WINDOW + 1
    middle = sum(weight * values[i : i + num] for i, weight in enumerate(SMOOTH))
    return jnp.concatenate([values[:2], middle, values[-2:]])


def residual_rate(nominal: AnyCar, x: State, u: Control, after: State, dt: Array) -> Float[Array, "3"]:
    """Return the constant rate d for which one RK4 step of f + d leads from `x` to `after` [SI per second].

    The MPC uses the same definition of d, so that data and prediction agree at any step length.
    """

    def correct(_, d: State) -> State:
        predicted = rk4_step(lambda w: jax.tree.map(jnp.add, nominal(w, u), d), x, dt)
        return jax.tree.map(lambda d, a, b: d + (a - b) / dt, d, after, predicted)

    # a loop, because XLA would merge the sweeps into one expression and evaluate its parts repeatedly
    return jnp.stack(jax.lax.fori_loop(0, 1 + SWEEPS, correct, jax.tree.map(jnp.zeros_like, x)))


def lag_response(command: Float[Array, "T *n"], lag: Array, dt: Array) -> tuple[Array, Array]:
    """Return the response of a first-order lag [s] to held commands: at each sample, and the mean over the next step.

    It starts from 0, as do the actuators of a rolling plant and the driver's state.
    """

    def step(value, target):
        mean, end = lag_step(value, target, lag, dt)
        return end, (value, mean)

    return jax.lax.scan(step, jnp.zeros_like(command[0]), command)[1]


def lagged_input(command: Float[Array, " T"], lag: Array, dt: Array) -> Float[Array, " T"]:
    """Return the mean over each step of the first-order lag response [s] to the command held during it."""
    return lag_response(command, lag, dt)[1]


def delayed(command: Float[Array, " T"], delay: Array, dt: Array) -> Float[Array, " T"]:
    """Return the mean over each step of the command that acts there, `delay` [s] after its sample; 0 before the first.

    Within a step a command that changes is replaced by its mean, as the lags are slower than that.
    """
    steps = delay / dt
    at = jnp.arange(len(command))

    def earlier(k: Array) -> Array:
        return jnp.where(at >= k, command[jnp.maximum(at - k, 0)], 0.0)

    whole = jnp.floor(steps + 1e-9).astype(int)
    part = steps - whole
    return (1 - part) * earlier(whole) + part * earlier(whole + 1)


class Samples(NamedTuple):
    """Consecutive smoothed states of a lap, the commands between them, and which pairs are valid (T-1,)."""

    before: State
    after: State
    command: Control
    mask: Bool[Array, " T-1"]


def acting_commands(trace: Trace, delay: Array, dt: Array) -> Control:
    """Return the commands of a lap as they act, `delay` [s] after their samples."""
    return Control(*(delayed(command, delay, dt) for command in trace.command))


def samples(trace: Trace, command: Control) -> Samples:
    """Return pairs of measured states from one lap (time on the leading axis), between which `command` acted.

    A pair is valid where the drift controller drove, including the corner entry, where the model would otherwise have
    no data, and where the whole smoothing window belongs to the lap.
    """
    x = State(smooth(trace.sensed.V), smooth(trace.sensed.beta), smooth(trace.sensed.r))
    before, after = jax.tree.map(lambda a: a[:-1], x), jax.tree.map(lambda a: a[1:], x)
    # a sample is whole where its window lies within the lap, which never goes on after it has ended
    half = WINDOW // 2
    outside = jnp.zeros(half, bool)
    alive = jnp.concatenate([outside, trace.alive, outside])
    whole = alive[: trace.alive.shape[0]] & alive[2 * half :]
    finite = jnp.all(jnp.isfinite(jnp.stack([*before, *after])), axis=0)
    mask = whole[:-1] & whole[1:] & trace.decision.drifting[:-1] & finite
    return Samples(before, after, jax.tree.map(lambda a: a[:-1], command), mask)


def rows(nominal: AnyCar, lap: Samples, dt: Array, lags: Float[Array, "2"]) -> tuple[Array, Array, Array]:
    """Return inputs (T-1, 5), residual rates (T-1, 3) and which rows are valid.

    Only measurements and commands are used. The inputs hold the commands after the `lags` of steering and drive [s]:
    with the bare commands most of the residual would be the lag, which no function of the present state and command
    describes.
    """
    u = Control(*(lagged_input(command, lag, dt) for command, lag in zip(lap.command, lags, strict=True)))
    d = jax.vmap(lambda x, u, after: residual_rate(nominal, x, u, after, dt))(lap.before, u, lap.after)
    mask = lap.mask & jnp.all(jnp.isfinite(d), axis=1)
    z = features(lap.before, u)
    return jnp.where(mask[:, None], z, 0.0), jnp.where(mask[:, None], d, 0.0), mask


def known_effect_basis(
    car: AnyCar, free: tuple[str, ...] = ()
) -> Callable[[Float[Array, "N 5"]], Float[Array, "N 3 K"]] | None:
    """Return the derivatives of the rates by the effect parameters at GP inputs; None for the nominal car.

    Parameters of the effects `free`, which are fitted themselves, are left out.
    """
    if isinstance(car, SingleTrack) or not set(car.names) - set(free):
        return None
    fixed = car.columns(tuple(set(car.names) - set(free)))
    return jax.vmap(lambda z: slopes_by_parameters(car, z)[:, fixed])


def slopes_by_parameters(car: Extended, z: Float[Array, "5"]) -> Float[Array, "3 K"]:
    """Return the derivatives of the rates by the effect parameters at one GP input."""
    x, u = State(z[0], z[1], z[2]), Control(z[3], z[4])
    return jax.jacfwd(lambda theta: jnp.stack(car.with_parameters(theta)(x, u)))(car.theta)


def estimate_lags(nominal: AnyCar, lap: Samples, dt: Array) -> Float[Array, "2"]:
    """Estimate the time constants [s] of steering and drive that leave least of the residual unexplained in one lap.

    All pairs on a grid are compared: least sum of log variances of the residuals of a linear regression on the inputs,
    which is the maximum likelihood of a linear model with unknown noise per output.
    """
    pairs = dt * jnp.stack(jnp.meshgrid(LAG_STEPS, LAG_STEPS, indexing="ij"), axis=-1).reshape(-1, 2)

    def unexplained(lags: Array) -> Array:
        Z, Y, mask = rows(nominal, lap, dt, lags)
        weight = mask[:, None] / jnp.maximum(jnp.sum(mask), 1)
        centre = jnp.sum(weight * Z, axis=0)
        spread = jnp.sqrt(jnp.sum(weight * (Z - centre) ** 2, axis=0))
        W = jnp.where(mask[:, None], (Z - centre) / jnp.where(spread > 0, spread, 1.0), 0.0)
        A = jnp.concatenate([W, mask[:, None].astype(W.dtype)], axis=1)
        normal = A.T @ A + RIDGE * jnp.eye(A.shape[1])
        left = jnp.where(mask[:, None], Y - A @ jnp.linalg.solve(normal, A.T @ Y), 0.0)
        return jnp.sum(jnp.log(jnp.sum(weight * left**2, axis=0) + TINY))

    return pairs[jnp.argmin(jax.vmap(unexplained)(pairs))]
