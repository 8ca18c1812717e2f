"""The nominal car plus a learnt residual rate: x_dot = f(x, u) + d(x, u) (Wu et al. 2025, Eq. 4)."""

from collections.abc import Callable

import equinox as eqx
from jax import Array

from driftjax.core import Control, State, features


class Corrected(eqx.Module):
    """Any car model with a residual rate added; `residual` maps z (5,) to (dV, dbeta, dr) (3,) in SI per second."""

    nominal: Callable[[State, Control], State]
    residual: Callable[[Array], Array]

    def __call__(self, x: State, u: Control) -> State:
        """Time derivative of `x`."""
        dx, d = self.nominal(x, u), self.residual(features(x, u))
        return State(dx.V + d[0], dx.beta + d[1], dx.r + d[2])
