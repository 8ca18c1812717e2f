"""Noisy sensors: measurements of the car's motion by GNSS/INS or motion capture."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import find_config, from_dict, markov_step, read_yaml, require
from driftjax.vehicle import Motion

SLOW = 1 << 20  # folded into a sample's key for the noise of the slow errors


@dataclass(frozen=True)
class SensorConfig:
    """Errors of the sensors: white noise, slow errors and bias of the channels, and the delay of the control loop."""

    sigma_V: float = 0.0
    """Speed [m/s]."""
    sigma_beta: float = 0.0
    """Sideslip [rad]."""
    sigma_r: float = 0.0
    """Yaw rate [rad/s]."""
    sigma_x: float = 0.0
    """Position along x [m]."""
    sigma_y: float = 0.0
    """Position along y [m]."""
    sigma_psi: float = 0.0
    """Heading [rad]."""
    slow_V: float = 0.0
    """Standard deviation of a slow error of the speed [m/s], a first-order process; so for the other channels."""
    slow_beta: float = 0.0
    """Of the sideslip [rad]."""
    slow_r: float = 0.0
    """Of the yaw rate [rad/s]."""
    slow_x: float = 0.0
    """Of the position along x [m]."""
    slow_y: float = 0.0
    """Of the position along y [m]."""
    slow_psi: float = 0.0
    """Of the heading [rad]."""
    slow_time: float = 0.5
    """Correlation time of the slow errors [s]."""
    bias_beta: float = 0.0
    """Constant error of the sideslip, as of a sensor mounted askew [rad]."""
    delay: float = 0.0
    """Time from a sample to the moment at which the command computed from it reaches the actuators [s]."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name.startswith(("sigma_", "slow_")):
                require(value >= 0, f"key '{name}' is {value}; a standard deviation must not be negative.")
        require(self.slow_time > 0, f"key 'slow_time' is {self.slow_time}; it must be a positive time in seconds.")
        require(self.delay >= 0, f"key 'delay' is {self.delay}; it must not be negative.")

    def of_channels(self, kind: Literal["sigma", "slow"]) -> Float[Array, "6"]:
        """Return the standard deviations of V, beta, r, x, y, psi."""
        return jnp.array([getattr(self, f"{kind}_{name}") for name in Measurement._fields])


class Measurement(NamedTuple):
    """Measured motion, as controller and log receive it; fields scalar or of one batch shape."""

    V: Array  # speed of the centre of mass [m/s]
    beta: Array  # sideslip, left positive [rad]
    r: Array  # yaw rate, left positive [rad/s]
    x: Array  # position [m]
    y: Array  # position [m]
    psi: Array  # heading, not wrapped [rad]


def load_sensors(name: str | Path) -> SensorConfig:
    """Load a sensor YAML: a path, or the name of a shipped set.

    `sedan` is GNSS/INS and `rc` motion capture at their best; `sedan_field` and `rc_field` have slow errors, a bias of
    the sideslip and a delay of 40 ms, and `rc_field` the position of a lidar.
    """
    path = find_config("sensors", name)
    return from_dict(SensorConfig, read_yaml(path), str(path))


def first_slow_errors(sensors: SensorConfig, *, key: Array) -> Float[Array, "6"]:
    """Draw the slow errors of the first sample."""
    return sensors.of_channels("slow") * jax.random.normal(jax.random.fold_in(key, SLOW), (6,))


def next_slow_errors(sensors: SensorConfig, slow: Float[Array, "6"], dt: Array, *, key: Array) -> Float[Array, "6"]:
    """Return the slow errors one sample of `dt` [s] later: a first-order Gauss-Markov process."""
    return markov_step(slow, first_slow_errors(sensors, key=key), jnp.exp(-dt / sensors.slow_time))


def measure(
    motion: Motion, sensors: SensorConfig, *, key: Array, slow: Float[Array, "6 ..."] | float = 0.0
) -> Measurement:
    """Add noise drawn from `key`, bias and `slow` errors to `motion`; the same key gives the same noise."""
    true = Measurement(motion.V, motion.beta + sensors.bias_beta, motion.r, motion.x, motion.y, motion.psi)
    noise = jax.random.normal(key, (6, *jnp.shape(motion.V)), jnp.result_type(motion.V))
    sigma = sensors.of_channels("sigma")
    slow = jnp.broadcast_to(slow, noise.shape)
    return Measurement(*(value + scale * unit + c for value, scale, unit, c in
                         zip(true, sigma, noise, slow, strict=True)))  # fmt: skip
