"""The nominal car with a learnt residual: x_dot = f(x, u) + d(x, u) (Wu et al. 2025, Eq. 4)."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State, features
from driftjax.gp import GP
from driftjax.vehicle.extended import AnyCar, Extended


class Residual(eqx.Module):
    """Learnt residual of a car: lags of its actuators, parameters of its effects, and the rate d(z) that remains.

    The rate is a GP that fades to zero far from its data; z holds the actuator outputs.
    """

    gp: GP
    trust_factor: Float[Array, "3"]  # share of each output that held-out data support, 0 to 1
    lags: Float[Array, "2"]  # time constants of steering and drive [s]; they only matter while commands change
    bounded: bool = eqx.field(static=True, default=True)  # False: the bare mean, however far from data
    tuning: Float[Array, "K"] = eqx.field(default_factory=lambda: jnp.zeros(0))  # added to the parameters of the car

    def __call__(self, z: Float[Array, "5"]) -> Float[Array, "3"]:
        """Return (dV, dbeta, dr) per second at z = (V, beta, r, delta, Fxr), SI."""
        return self.trust_factor * (self.gp.bounded_mean(z) if self.bounded else self.gp.mean(z))

    def scaled(self, share: Array) -> "Residual":
        """Return the residual times `share`: zero at 0, unchanged at 1."""
        trust_factor, lags, tuning = share * self.trust_factor, share * self.lags, share * self.tuning
        return Residual(self.gp, trust_factor, lags, self.bounded, tuning)

    def tuned(self, nominal: AnyCar) -> AnyCar:
        """Return the car with the learnt parameters; leaves of both may have a leading batch axis."""
        if isinstance(nominal, Extended) and self.tuning.shape[-1]:
            return nominal.with_parameters(nominal.theta + self.tuning)
        return nominal


class Corrected(eqx.Module):
    """Any car model with a residual rate added; `residual` maps z (5,) to (dV, dbeta, dr) (3,) in SI per second."""

    nominal: Callable[[State, Control], State]
    residual: Callable[[Array], Array]

    def __call__(self, x: State, u: Control) -> State:
        """Return the time derivative of `x`."""
        dx, d = self.nominal(x, u), self.residual(features(x, u))
        return State(dx.V + d[0], dx.beta + d[1], dx.r + d[2])


def no_residual(
    like: GP, lags: Float[Array, "2"] | None = None, bounded: bool = True, num_parameters: int = 0
) -> Residual:
    """Return a zero residual in the shapes of a learnt one (so nothing recompiles), for as many tuned parameters.

    `lags` of the actuators [s] may be known beforehand; zero if omitted.
    """
    lags = jnp.zeros(2) if lags is None else lags
    return Residual(like, jnp.zeros(3), lags, bounded, jnp.zeros(num_parameters))
