"""From a driven lap to what the model got wrong: rows (z, d) for the GP."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from driftjax.control.table import ReferenceTable
from driftjax.core import Control, State, features, lag_step, rk4_step
from driftjax.sim import Trace
from driftjax.vehicle import SingleTrack

WINDOW = 5  # samples of the local parabola; centred, so that it delays nothing
# Savitzky and Golay 1964: value at the middle of the least-squares parabola through five even samples
SMOOTH = (-3 / 35, 12 / 35, 17 / 35, 12 / 35, -3 / 35)
LAG_STEPS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0])  # time constants tried, in control steps
RIDGE, TINY = 1e-6, 1e-12  # keep the regression and its logarithm finite where a lap has no rows
SWEEPS = 2  # fixed-point corrections of the residual; each gains a factor dt times the model's rate


def smooth(values: Float[Array, " T"]) -> Float[Array, " T"]:
    """Centred parabola through five samples; the two samples at either end stay as they are."""
    middle = jnp.convolve(values, jnp.asarray(SMOOTH), mode="valid")
    return jnp.concatenate([values[:2], middle, values[-2:]])


def residual_rate(nominal: SingleTrack, x: State, u: Control, after: State, dt: Array) -> Float[Array, "3"]:
    """Constant rate d for which one RK4 step of f + d leads from `x` to `after` [SI per second].

    It is the definition of d inside the MPC too, so data and prediction agree at any step length.
    """

    def step(d):
        rates = lambda w: jax.tree.map(jnp.add, nominal(w, u), State(d[0], d[1], d[2]))
        return jnp.stack(rk4_step(rates, x, dt))

    d = jnp.zeros(3)
    for _ in range(1 + SWEEPS):
        d = d + (jnp.stack(after) - step(d)) / dt
    return d


def reached(command: Float[Array, " T"], lag: Array, dt: Array) -> Float[Array, " T"]:
    """Mean over each step of what a first-order lag [s] makes of the command held during it; at rest before."""
    step = lambda value, target: lag_step(value, target, lag, dt)[::-1]
    return jax.lax.scan(step, command[0], command)[1]


def rows(
    nominal: SingleTrack, trace: Trace, table: ReferenceTable, dt: Array, lags: Float[Array, "2"]
) -> tuple[Array, Array, Bool[Array, " T-1"]]:
    """Inputs (T-1, 5), residual rates (T-1, 3) and which rows are data, of one lap (time on the leading axis).

    Only measurements and commands are used. The inputs hold the commands as `reached` through the `lags` of steering
    and drive [s]: with the bare commands most of the residual would be the lag, which no function of the present
    state and command can say. A row counts where the drift controller drove in the drift section of `table` and all
    samples behind its smoothing belong to the lap.
    """
    x = State(smooth(trace.sensed.V), smooth(trace.sensed.beta), smooth(trace.sensed.r))
    before, after = jax.tree.map(lambda a: a[:-1], x), jax.tree.map(lambda a: a[1:], x)
    u = Control(reached(trace.command.delta, lags[0], dt)[:-1], reached(trace.command.Fxr, lags[1], dt)[:-1])
    d = jax.vmap(lambda x, u, after: residual_rate(nominal, x, u, after, dt))(before, u, after)
    alive = trace.alive.astype(float)
    whole = jnp.convolve(alive, jnp.ones(WINDOW), mode="same") > WINDOW - 0.5
    inside = (trace.sensed.s >= table.drift_start) & (trace.sensed.s <= table.drift_end)
    mask = inside[:-1] & whole[:-1] & whole[1:] & trace.decision.drifting[:-1] & jnp.all(jnp.isfinite(d), axis=1)
    z = features(before, u)
    return jnp.where(mask[:, None], z, 0.0), jnp.where(mask[:, None], d, 0.0), mask


def estimate_lags(nominal: SingleTrack, trace: Trace, table: ReferenceTable, dt: Array) -> Float[Array, "2"]:
    """Time constants [s] of steering and drive that leave the least of the residual unexplained in one lap.

    Every pair on a grid is tried: least sum of log variances left by a linear function of the inputs, which is the
    maximum likelihood of a linear model with unknown noise per output.
    """
    pairs = dt * jnp.stack(jnp.meshgrid(LAG_STEPS, LAG_STEPS, indexing="ij"), axis=-1).reshape(-1, 2)

    def unexplained(lags: Array) -> Array:
        Z, Y, mask = rows(nominal, trace, table, dt, lags)
        weight = mask[:, None] / jnp.maximum(jnp.sum(mask), 1)
        centre = jnp.sum(weight * Z, axis=0)
        spread = jnp.sqrt(jnp.sum(weight * (Z - centre) ** 2, axis=0))
        W = jnp.where(mask[:, None], (Z - centre) / jnp.where(spread > 0, spread, 1.0), 0.0)
        A = jnp.concatenate([W, mask[:, None].astype(W.dtype)], axis=1)
        normal = A.T @ A + RIDGE * jnp.eye(A.shape[1])
        left = jnp.where(mask[:, None], Y - A @ jnp.linalg.solve(normal, A.T @ Y), 0.0)
        return jnp.sum(jnp.log(jnp.sum(weight * left**2, axis=0) + TINY))

    return pairs[jnp.argmin(jax.vmap(unexplained)(pairs))]
