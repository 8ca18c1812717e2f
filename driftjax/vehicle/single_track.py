"""The paper's nominal car: single track, simplified Pacejka tyre; optional friction ellipse at the rear."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from driftjax.core import Control, State, as_float
from driftjax.core.elementary import arctan2, sincos
from driftjax.tyre import SimplifiedPacejka

G = 9.81  # gravitational acceleration [m/s^2]
LATERAL_FLOOR = 0.04  # square of the share of lateral force that no drive force takes away: keeps the slope finite
V_FLOOR = 1e-3  # speed below which beta_dot is held finite [m/s]


def lateral_share(used: Array) -> Array:
    """Return the share of the lateral force left to an axle when drive uses `used` of the squared friction [-]."""
    return jnp.sqrt(jnp.maximum(1 - used, LATERAL_FLOOR))


class SingleTrack(eqx.Module):
    """Nominal single-track car (Wu et al. 2025, Eq. 1-3); calling it gives the time derivative.

    `combined_slip` is not the paper's: the rear lateral force shrinks with the drive force, by
    sqrt(1 - (combined_slip Fxr / (mu Fzr))^2) (Hindiyeh and Gerdes 2014). At 0 the car is exactly the published one.
    """

    m: Array = eqx.field(converter=as_float)  # mass [kg]
    Iz: Array = eqx.field(converter=as_float)  # yaw moment of inertia [kg m^2]
    a: Array = eqx.field(converter=as_float)  # centre of mass to front axle [m]
    b: Array = eqx.field(converter=as_float)  # centre of mass to rear axle [m]
    tyre: SimplifiedPacejka
    combined_slip: Array = eqx.field(converter=as_float, default=0.0)  # 0 none, 1 a friction circle [-]

    @property
    def Fzf(self) -> Array:
        """Return the static load of the front axle [N]."""
        return self.m * G * self.b / (self.a + self.b)

    @property
    def Fzr(self) -> Array:
        """Return the static load of the rear axle [N]."""
        return self.m * G * self.a / (self.a + self.b)

    @property
    def peaks(self) -> tuple[Array, Array]:
        """Return the slip angle at which the front and the rear tyre reach their largest force [rad]."""
        peak = self.tyre.alpha_peak
        return peak, peak

    def slip_angles(self, x: State, u: Control) -> tuple[Array, Array]:
        """Return the front and rear slip angle [rad] (Eq. 3, with atan2, so that V = 0 stays finite)."""
        sin_beta, cos_beta = sincos(x.beta)
        vx, vy = x.V * cos_beta, x.V * sin_beta
        vx = jnp.where(jnp.abs(vx) < V_FLOOR, V_FLOOR, vx)
        alpha_f = arctan2(vy + self.a * x.r, vx) - u.delta
        alpha_r = arctan2(vy - self.b * x.r, vx)
        return alpha_f, alpha_r

    def lateral_forces(self, x: State, u: Control) -> tuple[Array, Array]:
        """Return the lateral force of front and rear axle in the wheel frames [N], left positive."""
        alpha_f, alpha_r = self.slip_angles(x, u)
        used = self.combined_slip * u.Fxr / (self.tyre.mu * self.Fzr)
        return self.tyre.lateral(alpha_f, self.Fzf), self.tyre.lateral(alpha_r, self.Fzr) * lateral_share(used**2)

    def __call__(self, x: State, u: Control) -> State:
        """Return the time derivative of `x` (Eq. 1)."""
        return self.rates(x, u, *self.lateral_forces(x, u))

    def rates(self, x: State, u: Control, Fyf: Array, Fyr: Array) -> State:
        """Return the time derivative of `x` under these lateral axle forces in the wheel frames [N]."""
        sin, cos = sincos(u.delta)
        Yf = Fyf * cos
        return self.accelerate(x, u.Fxr - Fyf * sin, Yf + Fyr, self.a * Yf - self.b * Fyr)

    def accelerate(self, x: State, X: Array, Y: Array, N: Array) -> State:
        """Return the time derivative of `x` under forces forward and to the left [N] and a yaw moment [N m]."""
        sin, cos = sincos(x.beta)
        along, across = X * cos + Y * sin, Y * cos - X * sin
        return State(along / self.m, across / (self.m * jnp.maximum(x.V, V_FLOOR)) - x.r, N / self.Iz)
