"""Combined slip: side force times sqrt(1 - (e + p) (F_x / (mu F_z))^2) (Hindiyeh and Gerdes 2014; Pacejka 2012, Ch. 4).

e is the model's own square of the ellipse's share, 0 none and 1 a friction circle; e + p stays at 0 where p < -e.
"""

import jax.numpy as jnp

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import CarParameters


def apply(car: CarParameters, p) -> CarParameters:
    """Add p to the square of the ellipse's share; for p > 0 the derivative is not zero even if that share was 0."""
    ellipse = car.ellipse + p[0]
    return car._replace(ellipse=jnp.where(ellipse < 0, 0.0, ellipse))


EFFECT = Effect(
    name="combined_slip",
    number=11,
    station="car",
    parameters=(Parameter("p", "1", 0.3, lower=-10 / 3),),
    apply=apply,
    source="Hindiyeh and Gerdes 2014; Pacejka 2012, Ch. 4",
    sentence="drive and brake force take more or less from the side force than in the model",
)
