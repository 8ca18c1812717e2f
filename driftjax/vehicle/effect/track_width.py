"""Track width: left and right wheels of an axle move in different directions (Milliken and Milliken 1995, Ch. 5).

At a yaw rate r they move forward at v_x - r t / 2 and v_x + r t / 2, so that their slip angles differ. An axle's force
is the mean over its two wheels, and the difference at the steered front wheels turns the car:
(t / 4) (F_yf,left - F_yf,right) sin(delta), with the axle's forces at the slip angle of either wheel. All of this
grows with t^2: p is its ratio to that of the track t = L / 2, so that t = sqrt(p) L / 2.
"""

import jax.numpy as jnp

from driftjax.core.elementary import arctan2, sin, sincos
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow, axle_forces
from driftjax.vehicle.single_track import V_FLOOR


def apply(flow: Flow, p) -> Flow:
    """Compute the tyre forces from the slip angles of both wheels of each axle."""
    car, x = flow.car, flow.x
    t = car.wheelbase / 2
    across, along = (x.V * share for share in sincos(x.beta))

    def direction(arm, side):
        forward = along - side * x.r * t / 2
        return arctan2(across + arm * x.r, jnp.where(jnp.abs(forward) < V_FLOOR, V_FLOOR, forward))

    def wheels(side):
        front, rear = (direction(arm, side) - direction(arm, 0.0) for arm in (car.a, -car.b))
        return axle_forces(flow._replace(alpha_f=flow.alpha_f + front, alpha_r=flow.alpha_r + rear))

    left, right = wheels(1.0), wheels(-1.0)
    mixed = lambda axle, a, b: axle + p[0] * ((a + b) / 2 - axle)
    moment = p[0] * t / 4 * (left.Fyf - right.Fyf) * sin(flow.u.delta)
    front, rear = mixed(flow.Fyf, left.Fyf, right.Fyf), mixed(flow.Fyr, left.Fyr, right.Fyr)
    return flow._replace(Fyf=front, Fyr=rear, N=flow.N + moment)


EFFECT = Effect(
    name="track_width",
    number=49,
    station="force",
    parameters=(Parameter("p", "1", 0.5, lower=0.0),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 5",
    sentence="the left and the right wheels slip differently as the car turns",
)
