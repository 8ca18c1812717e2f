"""Steady wind w in world axes: force c (|w - v| (w - v) + |v| v), which is 0 in still air (Hucho 1998, Ch. 5).

c = 0.002 m / L, 1.2 N s^2/m^2 for a sedan, the same from all sides; drag in still air is `aero_drag`. The force acts
L/10 in front of the centre of mass.
"""

import jax.numpy as jnp

from driftjax.core.elementary import sincos
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow

AREA = 0.002  # force over relative speed squared, over m / L [-]
ARM = 0.1  # of the force in front of the centre of mass, over the wheelbase [-]
CALM = 1e-3  # speed that keeps the norms smooth, over sqrt(g L) [-]


def apply(flow: Flow, p) -> Flow:
    """Add the force of the wind, written so that it is exactly zero without wind."""
    x, car, (sin, cos), (across, along) = flow.x, flow.car, sincos(flow.place.psi), sincos(flow.x.beta)
    vx, vy = x.V * along, x.V * across
    wx, wy = p[0] * cos + p[1] * sin, p[1] * cos - p[0] * sin
    floor = (CALM * car.unit_speed) ** 2
    through = jnp.sqrt((wx - vx) ** 2 + (wy - vy) ** 2 + floor)
    still = jnp.sqrt(vx**2 + vy**2 + floor)
    less = (2 * (vx * wx + vy * wy) - wx**2 - wy**2) / (through + still)
    c = AREA * car.m / car.wheelbase
    X, Y = c * (through * wx + less * vx), c * (through * wy + less * vy)
    return flow._replace(X=flow.X + X, Y=flow.Y + Y, N=flow.N + ARM * car.wheelbase * Y)


EFFECT = Effect(
    name="side_wind",
    number=36,
    station="force",
    parameters=(Parameter("w_x", "m/s", 1.0, "speed"), Parameter("w_y", "m/s", 1.0, "speed")),
    apply=apply,
    source="Hucho 1998, Ch. 5",
    sentence="wind pushes the car",
    needs=("psi",),
)
