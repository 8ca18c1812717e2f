"""Slope of the ground, climbing along world x and y positive (Bae, Ryu and Gerdes 2001, on the plane):

X - m g (grade_x cos psi + grade_y sin psi), Y + m g (grade_x sin psi - grade_y cos psi).
"""

from driftjax.core.elementary import sincos
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow
from driftjax.vehicle.single_track import G


def apply(flow: Flow, p) -> Flow:
    """Add the weight's part along the slope, downhill at every heading."""
    weight, (sin, cos) = flow.car.m * G, sincos(flow.place.psi)
    X = flow.X - weight * (p[0] * cos + p[1] * sin)
    return flow._replace(X=X, Y=flow.Y + weight * (p[0] * sin - p[1] * cos))


EFFECT = Effect(
    name="road_grade",
    number=35,
    station="force",
    parameters=(Parameter("grade_x", "rad", 0.035), Parameter("grade_y", "rad", 0.035)),
    apply=apply,
    source="Bae, Ryu and Gerdes 2001",
    sentence="the ground slopes",
    kinematic=True,
    needs=("psi",),
)
