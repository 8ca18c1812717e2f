"""Combined-slip Magic Formula of the plant, with load sensitivity."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from driftjax.core import as_float
from driftjax.core.elementary import arctan, sin

SLIP_FLOOR = 1e-4  # added in quadrature to the slip, so that its direction has a finite gradient at zero slip [-]


class MagicFormula(eqx.Module):
    r"""Isotropic Magic Formula by the similarity method (Pacejka 2012, Sec. 4.3): a friction circle.

    With the slip vector $s = (k\kappa, -\alpha)$ and $\rho = |s|$ the force is
    $F = \mu F_z \sin(C \arctan(B\rho - E(B\rho - \arctan B\rho)))\, s/\rho$, and friction falls with the load,
    $\mu = \mu_0 \exp(-\lambda (F_z/F_{z0} - 1))$. Fields broadcast against the slips: scalars or one entry per wheel.
    """

    mu: Array = eqx.field(converter=as_float)  # friction coefficient at the reference load [-]
    B: Array = eqx.field(converter=as_float)  # stiffness factor [1/rad]
    C: Array = eqx.field(converter=as_float)  # shape factor [-]
    E: Array = eqx.field(converter=as_float)  # curvature factor, at most 1 [-]
    slip_ratio: Array = eqx.field(converter=as_float)  # longitudinal over lateral slip stiffness, k [-]
    load_sensitivity: Array = eqx.field(converter=as_float)  # relative loss of friction per relative load [-]

    def friction(self, Fz: Array, Fz0: Array) -> Array:
        """Return the friction coefficient at vertical load `Fz` [N]; `Fz0` [N] is the reference load."""
        return self.mu * jnp.exp(-self.load_sensitivity * (Fz / Fz0 - 1))

    def saturation(self, kappa: Array, alpha: Array) -> Array:
        """Return the combined slip over about the peak's slip, B rho/2: below 1 the tyre grips, above it slides."""
        return self.B / 2 * jnp.sqrt((self.slip_ratio * kappa) ** 2 + alpha**2 + SLIP_FLOOR**2)

    def forces(self, kappa: Array, alpha: Array, Fz: Array, Fz0: Array) -> tuple[Array, Array]:
        """Return the longitudinal and lateral force in the wheel frame [N]: driving and left positive.

        `kappa` is positive when driving and `alpha` has the sign of the lateral velocity of the wheel, both over its
        travelling speed. The force has a non-negative product with (kappa, -alpha): sliding never adds energy.
        """
        slip = self.slip_ratio * kappa
        rho = jnp.sqrt(slip**2 + alpha**2 + SLIP_FLOOR**2)
        x = self.B * rho
        shape = sin(self.C * arctan(x - self.E * (x - arctan(x))))
        gain = self.friction(Fz, Fz0) * Fz * shape / rho
        return gain * slip, -gain * alpha
