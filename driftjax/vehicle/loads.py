"""Body of the plant: wheel positions and wheel loads, with roll and pitch lag."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from driftjax.core import as_float
from driftjax.vehicle.single_track import G

LOAD_FLOOR = 0.02  # smoothing of lift-off, as a share of the static load of the wheel


class Chassis(eqx.Module):
    """Rigid body with quasi-static load transfer that follows the accelerations through first-order lags.

    Wheels are ordered front left, front right, rear left, rear right everywhere.
    """

    m: Array = eqx.field(converter=as_float)  # mass [kg]
    Iz: Array = eqx.field(converter=as_float)  # yaw moment of inertia [kg m^2]
    a: Array = eqx.field(converter=as_float)  # centre of mass to front axle [m]
    b: Array = eqx.field(converter=as_float)  # centre of mass to rear axle [m]
    h: Array = eqx.field(converter=as_float)  # height of the centre of mass [m]
    track_f: Array = eqx.field(converter=as_float)  # front track width [m]
    track_r: Array = eqx.field(converter=as_float)  # rear track width [m]
    roll_split: Array = eqx.field(converter=as_float)  # share of the roll moment on the front axle [-]
    roll_lag: Array = eqx.field(converter=as_float)  # time constant of the lateral load transfer [s]
    pitch_lag: Array = eqx.field(converter=as_float)  # time constant of the longitudinal load transfer [s]
    drag: Array = eqx.field(converter=as_float)  # aerodynamic drag over speed squared, rho CdA / 2 [N s^2/m^2]

    def positions(self) -> tuple[Array, Array]:
        """Return the longitudinal and lateral position of the wheels in the body frame [m]."""
        px = jnp.stack([self.a, self.a, -self.b, -self.b])
        py = jnp.stack([self.track_f, -self.track_f, self.track_r, -self.track_r]) / 2
        return px, py

    def static_loads(self) -> Array:
        """Return the vertical loads at rest [N]."""
        front = self.m * G * self.b / (2 * (self.a + self.b))
        rear = self.m * G * self.a / (2 * (self.a + self.b))
        return jnp.stack([front, front, rear, rear])

    def transfer(self) -> tuple[Array, Array]:
        """Return the change of the vertical loads per longitudinal and per lateral acceleration [N s^2/m]."""
        pitch = self.m * self.h / (2 * (self.a + self.b))
        front = self.m * self.h * self.roll_split / self.track_f
        rear = self.m * self.h * (1 - self.roll_split) / self.track_r
        return jnp.stack([-pitch, -pitch, pitch, pitch]), jnp.stack([-front, front, -rear, rear])


def smooth_positive(x: Array, width: Array) -> Array:
    """Return the smooth positive part of `x`: (x + sqrt(x^2 + width^2))/2, which is width/2 at x = 0."""
    return (x + jnp.sqrt(x**2 + width**2)) / 2
