"""Yaw inertia: I_z (1 + p) (Gillespie 1992, Ch. 1)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Car


def apply(car: Car, p) -> Car:
    """Scale the yaw inertia."""
    return car._replace(Iz=car.Iz * (1 + p[0]))


EFFECT = Effect(
    name="yaw_inertia",
    number=24,
    station="car",
    parameters=(Parameter("p", "1", 0.15, upper=8.0),),
    apply=apply,
    source="Gillespie 1992, Ch. 1",
    sentence="the car resists turning more or less than the model",
)
