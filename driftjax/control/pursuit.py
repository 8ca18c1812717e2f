"""Pure pursuit with speed control, for the normal segments of the lap."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from driftjax.core import Control, as_float, require_at_least, require_positive
from driftjax.track import Track
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.single_track import G


@dataclass(frozen=True)
class PursuitConfig:
    """Pure pursuit (Wang et al. 2017 in the paper): steers along the circle through a look-ahead point of the path."""

    preview_time: float = 0.35
    """Look-ahead distance per speed [s]."""
    preview_min: float = 3.0
    """Shortest look-ahead distance [m]."""
    speed_gain: float = 2.0
    """Acceleration command per speed error [1/s]."""

    def __post_init__(self) -> None:
        require_at_least(self, 0, "preview_time")
        require_positive(self, "preview_min", "speed_gain")


class PurePursuit(eqx.Module):
    """Steering along the circle through the look-ahead point, force from the speed error."""

    preview_time: Array = eqx.field(converter=as_float)
    preview_min: Array = eqx.field(converter=as_float)
    speed_gain: Array = eqx.field(converter=as_float)
    wheelbase: Array = eqx.field(converter=as_float)
    b: Array = eqx.field(converter=as_float)
    m: Array = eqx.field(converter=as_float)
    mu: Array = eqx.field(converter=as_float)

    def __call__(
        self,
        path: Track,
        x: Array,
        y: Array,
        psi: Array,
        V: Array,
        r: Array,
        s: Array,
        speed: Array,
        acceleration: Array,
    ) -> Control:
        """Return the command of a car at (x, y, psi), `s` along `path`, for a target `speed` with rate `acceleration`.

        delta = atan(2 L sin(eta) / d), eta the bearing of the look-ahead point from the rear axle at distance d. The
        force leaves the rear axle the grip to turn at V and `r`, so that full drive out of a corner does not spin the
        car.
        """
        ahead = jnp.maximum(self.preview_min, self.preview_time * V)
        target_x, target_y, _, _ = path.pose(s + ahead)
        dx = target_x - (x - self.b * jnp.cos(psi))
        dy = target_y - (y - self.b * jnp.sin(psi))
        sin_eta_d = -dx * jnp.sin(psi) + dy * jnp.cos(psi)
        distance_squared = jnp.maximum(dx**2 + dy**2, 1e-6)
        delta = jnp.arctan(2 * self.wheelbase * sin_eta_d / distance_squared)
        load = self.m * (1 - self.b / self.wheelbase)  # that rests on the rear axle [kg]
        left = load * jnp.sqrt(jnp.maximum((self.mu * G) ** 2 - (V * r) ** 2, 1e-6))
        return Control(delta, jnp.clip(self.m * (acceleration + self.speed_gain * (speed - V)), -left, left))


def pure_pursuit(config: PursuitConfig, vehicle: VehicleConfig) -> PurePursuit:
    """Build the controller of one car."""
    car = {"wheelbase": vehicle.a + vehicle.b, "b": vehicle.b, "m": vehicle.m, "mu": vehicle.mu}
    return PurePursuit(**vars(config), **car)
