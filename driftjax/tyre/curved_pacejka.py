"""Tyre of the nominal car whose side force over slip may have another form than the formula's."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from driftjax.core import as_float
from driftjax.core.elementary import arctan, sin

MARGIN = 1e-6  # added in quadrature to pi - |theta|, so that gradients stay finite where the formula's force ends [rad]
GRID, NEWTON = 64, 2  # points at which the peak is sought, and iterations from the nearest of them
LAST = 0.995  # t of the largest slip at which it is sought, 127/B


@jax.custom_jvp
def bent_angle(bent: Array, C: Array, c2: Array, c3: Array, c4: Array) -> Array:
    """Return theta + D at `bent` = arctan(B alpha), element by element."""
    theta, t = C * bent, 2 / jnp.pi * jnp.abs(bent)
    # integral of rho - 1 from 0 to t, over t
    mean = t**2 * (2 * c2 + t * (c3 - 3 * c2 + t * (6 * c2 - 4 * c3 + c4) / 5))
    change = theta * mean
    return theta + change / jnp.sqrt(1 + change**2 / ((jnp.pi - jnp.abs(theta)) ** 2 + MARGIN**2))


@bent_angle.defjvp
def _bent_angle_jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    """Return the angle and its derivative: the slopes are computed once, however many directions there are.

    Without the barrier XLA recomputes shared values in every derivative that it fuses.
    """
    angle, pull = jax.vjp(bent_angle.fun, *jnp.broadcast_arrays(*primals))
    angle, slopes = jax.lax.optimization_barrier((angle, pull(jnp.ones_like(angle))))
    return angle, sum((slope * one for slope, one in zip(slopes, tangents, strict=True)), jnp.zeros_like(angle))


class CurvedPacejka(eqx.Module):
    r"""$F_y = -\mu F_z \sin(\theta + D)$, with $\theta = C \arctan(B\alpha)$ of the formula and a free-form change D.

    Over $t = 2/\pi\,|\arctan(B\alpha)|$, 0 at no slip and 1 at infinite slip, the formula's angle rises at one rate.
    Here the rate is multiplied by $\rho(t) = 1 + \sum_j c_j\, b_{j,4}(t)$, j = 2, 3, 4, with Bernstein's polynomials b
    of degree 4: B-splines without inner knots, integrated for a monotone curve as in Ramsay (1988, "Monotone regression
    splines in action"). They are at least 0 and all five add to 1, so that rho is positive for c above -1: the angle
    rises, and its sine rises to one peak and then falls. Near no slip rho is 1, and the peak is at the angle pi/2:
    cornering stiffness and largest force are the formula's. The change D is limited to what is left to the angle pi,
    where the force would change sign. At c = 0 the force is the formula's to the bit.
    """

    mu: Array = eqx.field(converter=as_float)  # friction coefficient [-]
    B: Array = eqx.field(converter=as_float)  # stiffness factor [1/rad]
    C: Array = eqx.field(converter=as_float)  # shape factor [-]
    curve: tuple[Array, ...]  # c_2, c_3, c_4: relative rise of the rate about t = 1/2, 3/4, 1 [-]

    def lateral(self, alpha: Array, Fz: Array) -> Array:
        """Return the lateral force [N], left positive, at slip angle `alpha` [rad] and vertical load `Fz` [N]."""
        return -self.mu * Fz * sin(self._angle(arctan(self.B * alpha)))

    def _angle(self, bent: Array) -> Array:
        """Return theta + D at `bent` = arctan(B alpha)."""
        return bent_angle(bent, self.C, *self.curve)

    @property
    def alpha_peak(self) -> Array:
        """Return the slip angle of the largest force [rad]: theta + D = pi/2; the largest angle for a rising force."""
        bent = jnp.pi / 2 * jnp.linspace(0.0, LAST, GRID)
        at = jnp.interp(jnp.pi / 2, self._angle(bent), bent)
        for _ in range(NEWTON):
            angle, slope = jax.jvp(self._angle, (at,), (jnp.ones_like(at),))
            at = jnp.clip(at - (angle - jnp.pi / 2) / slope, 0.0, bent[-1])
        return jnp.tan(at) / self.B
