"""Steering lag: tau delta_dot + delta = delta_command."""

import jax.numpy as jnp

from driftjax.core import Control, lag_step
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(memory, u: Control, V, dt, p):
    """Return the mean angle over the step; `memory` is the lagged angle."""
    mean, end = lag_step(memory, u.delta, p[0], dt)
    return end, u._replace(delta=mean)


def start(dt: float):
    """Return the lagged angle at rest."""
    return jnp.zeros(())


EFFECT = Effect(
    name="steer_lag",
    number=31,
    station="command",
    parameters=(Parameter("tau", "s", 0.13, "time", lower=0.0, upper=12.0),),
    apply=apply,
    start=start,
    source="first-order actuator; Pacejka 2012, Sec. 1.3",
    sentence="the steering lags behind its command",
)
