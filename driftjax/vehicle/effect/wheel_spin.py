"""Wheel spin: q V F_xr_dot + F_xr = F_command (after Goh, Goel and Gerdes 2020).

Wheel inertia I_w and radius R_w with force C_kappa kappa at the slip kappa = (omega R_w - V) / V give the lag
(I_w / R_w^2) V / C_kappa: q is the wheels' inertia as a mass over the slip stiffness, which in a slide is a small part
of the tyre's at rest. Its growth with speed distinguishes it from `drive_lag`.
"""

from driftjax.core import Control, lag_step
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.linear import at_rest


def apply(memory, u: Control, V, dt, p):
    """Return the mean force over the step; `memory` is the lagged force."""
    mean, end = lag_step(memory, u.Fxr, p[0] * V, dt)
    return end, u._replace(Fxr=mean)


EFFECT = Effect(
    name="wheel_spin",
    number=20,
    station="command",
    parameters=(Parameter("q", "s^2/m", 0.04, "per_acceleration", lower=0.0),),
    apply=apply,
    source="Goh, Goel and Gerdes 2020",
    sentence="the wheels first have to spin up, so that the drive force lags the more the faster the car is",
    start=at_rest,
)
