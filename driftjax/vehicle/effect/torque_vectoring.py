"""Torque vectoring: N + K (r_ref - r), r_ref = V delta / (L (1 + (V / V_ch)^2)) (Rajamani 2012, Ch. 8).

The characteristic speed V_ch is fixed at 3.5 sqrt(g L), 19 m/s for a sedan.
"""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow

CHARACTERISTIC = 3.5  # characteristic speed over sqrt(g L) [-]


def apply(flow: Flow, p) -> Flow:
    """Add a yaw moment towards the yaw rate of an understeering car at this steering angle."""
    V, car = flow.x.V, flow.car
    reference = V * flow.u.delta / (car.wheelbase * (1 + (V / (CHARACTERISTIC * car.unit_speed)) ** 2))
    return flow._replace(N=flow.N + p[0] * (reference - flow.x.r))


EFFECT = Effect(
    name="torque_vectoring",
    number=22,
    station="force",
    parameters=(Parameter("K", "N m s", 0.03, "yaw_damping", lower=0.0),),
    apply=apply,
    source="Rajamani 2012, Ch. 8",
    sentence="a yaw control turns the car towards what the driver steers",
)
