"""Lateral load transfer: mu_f (1 - k_f (a_y / g)^2), mu_r (1 - k_r (a_y / g)^2) (Milliken and Milliken 1995, Ch. 18).

With load sensitivity e and the transfer dF_z = m a_y h zeta / t, an axle loses about e (dF_z / F_z)^2 of its grip; k is
that loss at 1 g, so that k_f : k_r gives the roll split. While roll lags, a_y is what the roll has reached.
"""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow
from driftjax.vehicle.single_track import G


def apply(flow: Flow, p) -> Flow:
    """Lower the friction of each axle with the square of the lateral acceleration."""
    square = ((flow.ay + flow.ay_lag) / G) ** 2
    return flow._replace(muf=flow.muf * (1 - p[0] * square), mur=flow.mur * (1 - p[1] * square))


EFFECT = Effect(
    name="load_transfer_lat",
    number=10,
    station="friction",
    parameters=(Parameter("k_f", "1", 0.04, lower=0.0), Parameter("k_r", "1", 0.04, lower=0.0)),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 18",
    sentence="in hard turns the axles lose grip because the load moves to the outer wheels",
)
