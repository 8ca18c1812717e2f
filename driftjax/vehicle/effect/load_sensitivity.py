"""Load sensitivity of both axles: mu (1 - k (F_z - F_z0) / F_z0), F_z0 the static load (Pacejka 2012, p_Dy2).

The nominal car moves no load between its axles, so that k alone would change nothing. The tyres' load is therefore
taken to move at least as with a centre of mass at the height L/10; a greater height, found as `load_transfer_long`,
takes its place. What k costs through the load of left and right wheel is `load_transfer_lat`.
"""

import jax.numpy as jnp

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow

HEIGHT = 0.1  # least height of the centre of mass, over the wheelbase [-]


def apply(flow: Flow, p) -> Flow:
    """Lower the friction of each axle in proportion to its load beyond the static one."""
    car = flow.car
    moved = (flow.Fzr * car.b - flow.Fzf * car.a) / car.wheelbase
    least = HEIGHT * car.m * flow.ax
    extra = jnp.where(jnp.abs(moved) > jnp.abs(least), 0.0, least - moved)
    front = (flow.Fzf - extra) / car.nominal.Fzf - 1
    rear = (flow.Fzr + extra) / car.nominal.Fzr - 1
    return flow._replace(muf=flow.muf * (1 - p[0] * front), mur=flow.mur * (1 - p[0] * rear))


EFFECT = Effect(
    name="load_sensitivity",
    number=8,
    station="friction",
    parameters=(Parameter("k", "1", 0.1, lower=0.0),),
    apply=apply,
    source="Pacejka 2012, Sec. 4.3 (p_Dy2)",
    sentence="the tyres lose friction as their load grows",
    reads_acceleration=True,
)
