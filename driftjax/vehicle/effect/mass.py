"""Mass: m (1 + p); the axle loads go with it, the yaw inertia does not (Gillespie 1992, Ch. 1)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Car


def apply(car: Car, p) -> Car:
    """Scale the mass."""
    return car._replace(m=car.m * (1 + p[0]))


EFFECT = Effect(
    name="mass",
    number=23,
    station="car",
    parameters=(Parameter("p", "1", 0.06),),
    apply=apply,
    source="Gillespie 1992, Ch. 1",
    sentence="the car is heavier or lighter than the model",
)
