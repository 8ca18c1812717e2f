"""Steering and drive of the plant: first-order lags with rate, range and power limits."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from driftjax.core import Control, as_float


class Actuators(eqx.Module):
    """Actuators: road-wheel angle and drive force from commands."""

    steer_lag: Array = eqx.field(converter=as_float)  # time constant of the steering [s]
    delta_max: Array = eqx.field(converter=as_float)  # largest road-wheel angle, either side [rad]
    delta_rate_max: Array = eqx.field(converter=as_float)  # largest steering rate [rad/s]
    drive_lag: Array = eqx.field(converter=as_float)  # time constant of drive and brake [s]
    Fxr_min: Array = eqx.field(converter=as_float)  # strongest braking force of the rear axle, negative [N]
    Fxr_max: Array = eqx.field(converter=as_float)  # strongest driving force of the rear axle [N]
    Fxr_rate_max: Array = eqx.field(converter=as_float)  # largest rate of that force [N/s]
    power_max: Array = eqx.field(converter=as_float)  # largest driving power [W]
    creep_speed: Array = eqx.field(converter=as_float)  # rim speed below which power and brake limits fade [m/s]

    def rates(self, delta: Array, drive: Array, command: Control) -> tuple[Array, Array]:
        """Return the rates of the road-wheel angle [rad/s] and of the drive force [N/s]."""
        steer = (jnp.clip(command.delta, -self.delta_max, self.delta_max) - delta) / self.steer_lag
        push = (jnp.clip(command.Fxr, self.Fxr_min, self.Fxr_max) - drive) / self.drive_lag
        return (
            jnp.clip(steer, -self.delta_rate_max, self.delta_rate_max),
            jnp.clip(push, -self.Fxr_rate_max, self.Fxr_rate_max),
        )

    def limit_power(self, drive: Array, rim_speed: Array) -> Array:
        """Return the drive force within the power limit [N] at the mean rim speed of the driven wheels [m/s]."""
        return jnp.minimum(drive, self.power_max / jnp.sqrt(rim_speed**2 + self.creep_speed**2))
