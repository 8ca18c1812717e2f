"""Wheels of the plant: spin, transient slip, rolling resistance and the rear differential."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from driftjax.core import as_float

SPEED_FLOOR = 1e-3  # added in quadrature to the travelling speed of a wheel, for a finite gradient at rest [m/s]
SATURATION_MAX = 8.0  # bounds that rise, so that an explicit step stays stable in any wheelspin [-]


def relaxation_speedup(saturation: Array) -> Array:
    r"""Return the divisor of the relaxation length at `saturation` q: $\sqrt{(1+q^2)/(1+(q/q_{max})^2)}$."""
    return jnp.sqrt((1 + saturation**2) / (1 + (saturation / SATURATION_MAX) ** 2))


class Wheels(eqx.Module):
    """Four spinning wheels whose tyres relax; the rear pair shares a drive and a differential."""

    radius: Array = eqx.field(converter=as_float)  # rolling radius [m]
    inertia: Array = eqx.field(converter=as_float)  # spin inertia of one wheel [kg m^2]
    drive_inertia: Array = eqx.field(converter=as_float)  # motor and gear, reflected to the rear axle [kg m^2]
    relaxation: Array = eqx.field(converter=as_float)  # lateral relaxation length [m]
    relaxation_long: Array = eqx.field(converter=as_float)  # longitudinal relaxation length [m]
    carcass_time: Array = eqx.field(converter=as_float)  # damping over stiffness of the carcass [s]
    rolling_resistance: Array = eqx.field(converter=as_float)  # rolling resistance over load [-]
    diff_coupling: Array = eqx.field(converter=as_float)  # viscous: 0 open, large locked [N m s/rad]
    diff_preload: Array = eqx.field(converter=as_float)  # friction torque without drive [N m]
    diff_bias: Array = eqx.field(converter=as_float)  # friction torque over axle torque [-]
    diff_speed: Array = eqx.field(converter=as_float)  # speed difference at which that friction is full [rad/s]
    creep_speed: Array = eqx.field(converter=as_float)  # rim speed below which brake and rolling resistance fade [m/s]

    def slip_rates(
        self, v: Array, w: Array, omega: Array, kappa: Array, alpha: Array, saturation: Array
    ) -> tuple[Array, Array]:
        r"""Return the rates of the transient slips [1/s] of wheels moving at `v` ahead and `w` to the left [m/s].

        $\sigma\dot\kappa + |u|\kappa = \omega R - v$ and $\sigma\dot\alpha + |u|\alpha = w$ (Pacejka 2012, Sec. 7.2)
        with the travelling speed $|u| = \sqrt{v^2 + w^2}$ in place of |v|: alpha tends to the sine of the slip angle,
        bounded at any sideslip, and the pair keeps the direction of the sliding velocity. The relaxation length is
        divided by `quickening` at `saturation` q, since a sliding tyre loads its carcass no further.
        """
        speed = jnp.sqrt(v**2 + w**2 + SPEED_FLOOR**2)
        quicker = relaxation_speedup(saturation)
        kappa_rate = (omega * self.radius - v - speed * kappa) * quicker / self.relaxation_long
        return kappa_rate, (w - speed * alpha) * quicker / self.relaxation

    def spin_rates(self, omega: Array, drive: Array, Fx: Array, Fz: Array) -> Array:
        """Return the angular accelerations [rad/s^2] under the rear axle force `drive` [N] and tyre forces `Fx` [N].

        A negative `drive` is a brake: it opposes the rotation and fades below the creep speed, so that it cannot
        turn a wheel backwards. Drive inertia resists the mean of the rear wheels only.
        """
        facing = jnp.tanh(omega * self.radius / self.creep_speed)
        rear = jnp.array([0.0, 0.0, 0.5, 0.5], omega.dtype)
        push = rear * (jnp.maximum(drive, 0) + jnp.minimum(drive, 0) * facing)
        torque = self.radius * (push - Fx - self.rolling_resistance * Fz * facing)
        difference = omega[2] - omega[3]
        friction = self.diff_preload + self.diff_bias * self.radius * jnp.abs(drive)
        locking = self.diff_coupling * difference + friction * jnp.tanh(difference / self.diff_speed)
        torque = torque + locking * jnp.array([0.0, 0.0, -1.0, 1.0], omega.dtype)
        mean = (torque[2] + torque[3]) / 2
        shared = mean * (1 / (self.inertia + self.drive_inertia / 2) - 1 / self.inertia)
        return torque / self.inertia + shared * (2 * rear)
