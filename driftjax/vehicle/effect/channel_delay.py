"""Delay of each measurement: y_i(t - d_i) (Ljung 1999, Sec. 4.5).

Here y_i - d_i y_i_dot with the mean rate over the delay; whole steps of it are looked up where the past is known.
"""

from driftjax.core import State
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(x: State, dx: State, p) -> State:
    """Delay every measured quantity, to first order."""
    return State(x.V - p[0] * dx.V, x.beta - p[1] * dx.beta, x.r - p[2] * dx.r)


EFFECT = Effect(
    name="channel_delay",
    number=43,
    station="sensor",
    parameters=(
        Parameter("d_V", "s", 0.08, "time", lower=0.0, upper=12.0),
        Parameter("d_beta", "s", 0.08, "time", lower=0.0, upper=12.0),
        Parameter("d_r", "s", 0.08, "time", lower=0.0, upper=12.0),
    ),
    apply=apply,
    source="Ljung 1999",
    sentence="some measurements are late",
    kinematic=True,
    sensor_delay=True,
)
