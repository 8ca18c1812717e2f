"""Roll lag: tau a_roll_dot + a_roll = a_y, and grip goes with a_roll (Milliken and Milliken 1995, Ch. 18).

The roll-out follows a_roll; `roll_grip` in `flow` says what grip it takes, `load_transfer_lat` uses it too.
"""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Car


def apply(car: Car, p) -> Car:
    """Add to the time constant of the lateral load transfer."""
    return car._replace(roll_lag=car.roll_lag + p[0])


EFFECT = Effect(
    name="roll_lag",
    number=26,
    station="car",
    parameters=(Parameter("tau", "s", 0.2, "time", lower=0.0),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 18",
    sentence="the body takes time to roll, so that the grip follows a turn late",
    transient=True,
)
