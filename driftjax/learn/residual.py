"""From a driven lap to what the model got wrong: rows (z, d) for the GP."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from driftjax.control.table import ReferenceTable
from driftjax.core import Control, State, features, rk4_step
from driftjax.sim import Trace
from driftjax.vehicle import SingleTrack

WINDOW = 5  # samples of the local parabola; centred, so that it delays nothing
# Savitzky and Golay 1964: value at the middle of the least-squares parabola through five even samples
SMOOTH = (-3 / 35, 12 / 35, 17 / 35, 12 / 35, -3 / 35)
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


def rows(
    nominal: SingleTrack, trace: Trace, table: ReferenceTable, dt: Array
) -> tuple[Array, Array, Bool[Array, " T-1"]]:
    """Inputs (T-1, 5), residual rates (T-1, 3) and which rows are data, of one lap (time on the leading axis).

    Only measurements and commands are used. A row counts where the drift controller drove in the drift section of
    `table` and all samples behind its smoothing belong to the lap; before it, actuator lags are most of the residual.
    """
    x = State(smooth(trace.sensed.V), smooth(trace.sensed.beta), smooth(trace.sensed.r))
    before, after = jax.tree.map(lambda a: a[:-1], x), jax.tree.map(lambda a: a[1:], x)
    u = jax.tree.map(lambda a: a[:-1], trace.command)
    d = jax.vmap(lambda x, u, after: residual_rate(nominal, x, u, after, dt))(before, u, after)
    alive = trace.alive.astype(float)
    whole = jnp.convolve(alive, jnp.ones(WINDOW), mode="same") > WINDOW - 0.5
    inside = (trace.sensed.s >= table.drift_start) & (trace.sensed.s <= table.drift_end)
    mask = inside[:-1] & whole[:-1] & whole[1:] & trace.decision.drifting[:-1] & jnp.all(jnp.isfinite(d), axis=1)
    z = features(before, u)
    return jnp.where(mask[:, None], z, 0.0), jnp.where(mask[:, None], d, 0.0), mask
