"""Free form of an axle's side force: -mu F_z sin(theta + D), theta = C arctan(B alpha) (after Ramsay 1988).

Over t = 2/pi |arctan(B alpha)|, 0 at no slip and 1 at infinite slip, theta + D rises at rho(t) times theta's rate,
rho = 1 + sum_j (exp(p_j) - 1) b_j(t), j = 2, 3, 4, with Bernstein's polynomials b_j of degree 4: p_2 acts about
t = 1/2, before the peak, p_3 about the peak, p_4 at large slip. rho is positive, so that the force rises to one peak
and then falls, whatever p; D ends before the force would change sign. Cornering stiffness and largest force stay the
formula's: they belong to the axle's `stiffness` and `friction`.
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import CarParameters

BOUNDS = (-10.0, 5.0)  # in typical sizes: from a level angle, a fiftieth of the rate, to seven times the rate


@dataclass(frozen=True)
class FreeForm:
    """Give the tyres of one axle a form of their own."""

    field: str

    def __call__(self, car: CarParameters, p: tuple[Array, ...]) -> CarParameters:
        """Return the car with this curve."""
        return car._replace(**{self.field: tuple(jnp.expm1(one) for one in p)})


TYRE_CURVES = tuple(
    Effect(
        name=f"tyre_curve_{axle}",
        number=number,
        station="car",
        parameters=tuple(Parameter(f"p_{j}", "1", 0.4, "1", *BOUNDS) for j in (2, 3, 4)),
        apply=FreeForm(f"curve_{axle[0]}"),
        source="Ramsay 1988; Pacejka 2012, Sec. 4.3",
        on_request=True,
        sentence=f"the side force of the {axle} tyres takes another course with slip than the formula's",
    )
    for axle, number in (("front", 50), ("rear", 51))
)
