"""Simplified Pacejka tyre of the nominal car."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from driftjax.core import as_float
from driftjax.core.elementary import arctan, sin


class SimplifiedPacejka(eqx.Module):
    r"""$F_y = -\mu F_z \sin(C \arctan(B \alpha))$ (Wu et al. 2025, Eq. 2; Bakker et al. 1987), no combined slip."""

    mu: Array = eqx.field(converter=as_float)  # friction coefficient [-]
    B: Array = eqx.field(converter=as_float)  # stiffness factor [1/rad]
    C: Array = eqx.field(converter=as_float)  # shape factor [-]

    def lateral(self, alpha: Array, Fz: Array) -> Array:
        """Return the lateral force [N], left positive, at slip angle `alpha` [rad] and vertical load `Fz` [N]."""
        return -self.mu * Fz * sin(self.C * arctan(self.B * alpha))

    @property
    def alpha_peak(self) -> Array:
        """Return the slip angle of the largest force [rad]: C arctan(B alpha) = pi/2."""
        return jnp.tan(jnp.pi / (2 * self.C)) / self.B
