"""Lateral load transfer: mu_f (1 - k_f (a_y / g)^2), mu_r (1 - k_r (a_y / g)^2) (Milliken and Milliken 1995, Ch. 18).

With load sensitivity e and the transfer dF_z = m a_y h zeta / t, an axle loses about e (dF_z / F_z)^2 of its grip; k is
that loss at 1 g, so that k_f : k_r gives the roll split. The outer front wheel pulls harder than the inner one: steered
by delta they turn the car with -m a_y h_f (F_yf / F_zf) sin(delta), where h_f = h zeta_f; the track t cancels. While
roll lags, a_y is what the roll has reached.
"""

from driftjax.core.elementary import sin
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow
from driftjax.vehicle.single_track import G


def apply(flow: Flow, p) -> Flow:
    """Lower the friction of each axle with the square of the lateral acceleration, and add a yaw moment."""
    k_f, k_r, h_f = p
    ay = flow.ay + flow.ay_lag
    square = (ay / G) ** 2
    moment = flow.car.m * ay * h_f * flow.Fyf / flow.Fzf * sin(flow.u.delta)
    return flow._replace(muf=flow.muf * (1 - k_f * square), mur=flow.mur * (1 - k_r * square), N=flow.N - moment)


EFFECT = Effect(
    name="load_transfer_lat",
    number=10,
    station="friction",
    parameters=(
        Parameter("k_f", "1", 0.04, lower=0.0),
        Parameter("k_r", "1", 0.04, lower=0.0),
        Parameter("h_f", "m", 0.06, "length", lower=0.0, optional=True),
    ),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 18",
    sentence="in hard turns the load moves to the outer wheels, which costs the axles grip and turns the car",
    reads_acceleration=True,
)
