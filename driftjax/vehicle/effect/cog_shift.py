"""Shift of the centre of mass, forward positive: a - p, b + p (Milliken and Milliken 1995, Ch. 5)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import CarParameters


def apply(car: CarParameters, p) -> CarParameters:
    """Move the centre of mass between the axles, and the static loads with it."""
    return car._replace(a=car.a - p[0], b=car.b + p[0])


EFFECT = Effect(
    name="cog_shift",
    number=25,
    station="car",
    parameters=(Parameter("p", "m", 0.02, "length"),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 5",
    sentence="the centre of mass lies further forward or back than in the model",
)
