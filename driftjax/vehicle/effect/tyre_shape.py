"""Shape factor of all tyres, the fall of the side force past its peak: C (1 + p) (Pacejka 2012, Sec. 4.3)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Car


def apply(car: Car, p) -> Car:
    """Scale the shape factor of both axles."""
    return car._replace(Cf=car.Cf * (1 + p[0]), Cr=car.Cr * (1 + p[0]))


EFFECT = Effect(
    name="tyre_shape",
    number=6,
    station="car",
    parameters=(Parameter("p", "1", 0.06),),
    apply=apply,
    source="Pacejka 2012, Sec. 4.3",
    sentence="past its peak the side force of the tyres falls more or less than the model's",
)
