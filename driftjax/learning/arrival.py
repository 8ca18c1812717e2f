"""Estimate the arrival state, where the drift controller takes over; the corner is planned from it."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.control.table import ReferenceTable
from driftjax.core import Control
from driftjax.learning.residual import lag_response, smooth
from driftjax.sim import Trace


class Arrival(eqx.Module):
    """Mean state and commands at the take-over over the measured laps; the plan's values before the first lap."""

    x: Float[Array, " 5"]  # V, beta, r, e, theta
    command: Float[Array, " 2"]  # last delta, Fxr
    lagged_input: Float[Array, " 2"]  # actuator outputs delta, Fxr
    laps: Array


def planned_arrival(table: ReferenceTable, lead: Array | float) -> Arrival:
    """Return the planned arrival `lead` [m] before the drift section of `table`, on the path with its inputs."""
    x, u = table.state(table.drift_start - lead)
    inputs, zero = jnp.stack([u.delta, u.Fxr]), jnp.zeros_like(x.V)
    return Arrival(jnp.stack([x.V, x.beta, x.r, zero, -x.beta]), inputs, inputs, jnp.zeros((), int))


def update_arrival(
    before: Arrival, trace: Trace, command: Control, s0: Array, lags: Float[Array, " 2"], dt: Array
) -> Arrival:
    """Update `before` with one lap (time on the leading axis), from measurements and the commands that acted.

    `s0` [m] is where the drift controller takes over; a lap that does not get there changes nothing.
    """
    sensed = trace.sensed
    past = trace.alive & (sensed.s >= s0)
    n = jnp.maximum(jnp.argmax(past), 1)  # first sample beyond
    share = jnp.clip((s0 - sensed.s[n - 1]) / jnp.maximum(sensed.s[n] - sensed.s[n - 1], 1e-9), 0.0, 1.0)
    at = lambda values: values[n - 1] + share * (values[n] - values[n - 1])
    x = jnp.stack([at(smooth(values)) for values in (sensed.V, sensed.beta, sensed.r, sensed.e, sensed.theta)])
    commands = jnp.stack([command.delta, command.Fxr], axis=1)
    lagged_input, _ = lag_response(commands, lags, dt)
    known = jnp.any(past) & jnp.all(jnp.isfinite(x))
    mean = lambda old, new: jnp.where(known, old + (new - old) / (before.laps + 1), old)
    return Arrival(
        mean(before.x, x),
        mean(before.command, commands[n - 1]),
        mean(before.lagged_input, at(lagged_input)),
        before.laps + known,
    )
