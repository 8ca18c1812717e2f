"""Lag of the drive: tau F_xr_dot + F_xr = F_command (Rajamani 2012, Ch. 5)."""

import jax.numpy as jnp

from driftjax.core import Control, lag_step
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(memory, u: Control, V, dt, p):
    """Return the mean force over the step; `memory` is the lagged force."""
    mean, end = lag_step(memory, u.Fxr, p[0], dt)
    return end, u._replace(Fxr=mean)


def start(dt: float):
    """Return the lagged force at rest."""
    return jnp.zeros(())


EFFECT = Effect(
    name="drive_lag",
    number=18,
    station="command",
    parameters=(Parameter("tau", "s", 0.14, "time", lower=0.0, upper=12.0),),
    apply=apply,
    source="first-order actuator; Rajamani 2012, Ch. 5",
    sentence="the drive force lags behind its command",
    start=start,
)
