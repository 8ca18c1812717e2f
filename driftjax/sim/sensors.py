"""Noisy sensors: measurements of the car's motion by GNSS/INS or motion capture."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from driftjax.core import find_config, from_dict, read_yaml, require
from driftjax.vehicle import Motion


@dataclass(frozen=True)
class SensorConfig:
    """Standard deviations of the measurement noise, white and independent between channels."""

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

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require(value >= 0, f"key '{name}' is {value}; a standard deviation must not be negative.")


class Measurement(NamedTuple):
    """Measured motion, as controller and log receive it; fields scalar or of one batch shape."""

    V: Array  # speed of the centre of mass [m/s]
    beta: Array  # sideslip, left positive [rad]
    r: Array  # yaw rate, left positive [rad/s]
    x: Array  # position [m]
    y: Array  # position [m]
    psi: Array  # heading, not wrapped [rad]


def load_sensors(name: str | Path) -> SensorConfig:
    """Load a sensor YAML: a path, or the name of a shipped set (`sedan`: GNSS/INS, `rc`: motion capture)."""
    path = find_config("sensors", name)
    return from_dict(SensorConfig, read_yaml(path), str(path))


def measure(motion: Motion, sensors: SensorConfig, *, key: Array) -> Measurement:
    """Add Gaussian noise to `motion`, drawn from `key`; the same key gives the same noise."""
    sigma = [getattr(sensors, f"sigma_{name}") for name in Measurement._fields]
    true = Measurement(motion.V, motion.beta, motion.r, motion.x, motion.y, motion.psi)
    noise = jax.random.normal(key, (6, *jnp.shape(motion.V)), jnp.result_type(motion.V))
    return Measurement(*(value + scale * unit for value, scale, unit in zip(true, sigma, noise, strict=True)))
