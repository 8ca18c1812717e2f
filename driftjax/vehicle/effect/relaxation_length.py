"""Relaxation length of the tyres: sigma alpha_lag_dot + V alpha_lag = V alpha (Pacejka 2012, Ch. 7)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Car


def apply(car: Car, p) -> Car:
    """Add to the relaxation length of both axles; the roll-out lets the slip angles lag by it."""
    return car._replace(relaxation=car.relaxation + p[0])


EFFECT = Effect(
    name="relaxation_length",
    number=12,
    station="car",
    parameters=(Parameter("sigma", "m", 0.13, "length", lower=0.0),),
    apply=apply,
    source="Pacejka 2012, Ch. 7",
    sentence="the tyres need some distance to build up their side force",
    transient=True,
)
