"""The nominal car plus a learnt residual rate: x_dot = f(x, u) + d(x, u) (Wu et al. 2025, Eq. 4)."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State, features
from driftjax.gp import GP


class Residual(eqx.Module):
    """Learnt model of a car: the lags of its actuators, and the residual rate d(z) at the actuator outputs.

    The residual is a GP, faded to zero where it has no data.
    """

    gp: GP
    trust_factor: Float[Array, "3"]  # share of each output that held-out data support, 0 to 1
    lags: Float[Array, "2"]  # time constants of steering and drive [s]; they only matter while commands change
    bounded: bool = eqx.field(static=True, default=True)  # False: the bare mean, however far from data

    def __call__(self, z: Float[Array, "5"]) -> Float[Array, "3"]:
        """(dV, dbeta, dr) per second at z = (V, beta, r, delta, Fxr), SI."""
        return self.trust_factor * (self.gp.bounded_mean(z) if self.bounded else self.gp.mean(z))

    def scaled(self, share: Array) -> "Residual":
        """A share of what was learnt, from nothing at 0 to all of it at 1."""
        return Residual(self.gp, share * self.trust_factor, share * self.lags, self.bounded)


class Corrected(eqx.Module):
    """Any car model with a residual rate added; `residual` maps z (5,) to (dV, dbeta, dr) (3,) in SI per second."""

    nominal: Callable[[State, Control], State]
    residual: Callable[[Array], Array]

    def __call__(self, x: State, u: Control) -> State:
        """Time derivative of `x`."""
        dx, d = self.nominal(x, u), self.residual(features(x, u))
        return State(dx.V + d[0], dx.beta + d[1], dx.r + d[2])


def no_residual(like: GP, lags: Float[Array, "2"] | None = None, bounded: bool = True) -> Residual:
    """The residual of a car that has learnt nothing, in the shapes of one that has (so nothing recompiles).

    `lags` of its actuators [s] may be known beforehand; none where left out.
    """
    return Residual(like, jnp.zeros(3), jnp.zeros(2) if lags is None else lags, bounded)
