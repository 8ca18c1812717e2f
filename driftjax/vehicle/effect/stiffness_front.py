"""Cornering stiffness of the front axle: B_f (1 + p), stiffness B C mu F_z (Pacejka 2012, Sec. 4.3)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Car


def apply(car: Car, p) -> Car:
    """Scale the stiffness factor of the front tyres."""
    return car._replace(Bf=car.Bf * (1 + p[0]))


EFFECT = Effect(
    name="stiffness_front",
    number=4,
    station="car",
    parameters=(Parameter("p", "1", 0.15, lower=-5.5, upper=12.0),),
    apply=apply,
    source="Pacejka 2012, Sec. 4.3",
    sentence="the front tyres build up their side force with slip faster or slower than the model's",
)
