"""Reduce a car to the effects that an export target can represent, in plain numbers."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import yaml

from driftjax.core import write_text
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import EFFECTS, effects_by_name, reference
from driftjax.vehicle.effect.flow import CarParameters
from driftjax.vehicle.effect.linear import GRIP
from driftjax.vehicle.universal import Universal, base_car, universal_car

AXLES = (*GRIP, "stiffness_front", "stiffness_rear", "tyre_shape", "mass", "yaw_inertia", "cog_shift")
WHEEL = 0.105  # rolling radius over the wheelbase, for targets whose wheels spin [-]
TOP_SPEED = 9.0  # default top speed over sqrt(g L) [-]


@dataclass(frozen=True)
class TargetOptions:
    """Options of a target beyond the car."""

    top_speed: float | None = None
    """Top speed that the target's tables and limits reach; left out: 9 sqrt(g L), 49 m/s for a sedan [m/s]."""
    dt: float = 0.02
    """Sample time of the CasADi step [s]."""


class ReducedCar(NamedTuple):
    """Car reduced to the effects that the target can represent."""

    vehicle: VehicleConfig
    full: VehicleConfig  # the car with all its effects
    options: TargetOptions

    @property
    def name(self) -> str:
        """Return the car's name as part of a file name, without the underscore that some targets split names at."""
        return "".join(c if c.isalnum() else "-" for c in self.vehicle.name)

    @property
    def top_speed(self) -> float:
        """Return the top speed [m/s]."""
        return float(self.options.top_speed or TOP_SPEED * reference(self.vehicle, "speed"))

    def value(self, name: str) -> float:
        """Return the value of `effect.parameter`, SI; 0, its neutral value, where the car lacks it."""
        return next((one.value for one in self.vehicle.effects if one.name == name), 0.0)

    @property
    def car(self) -> Any:
        """Return the `CarParameters` of floats, with the effects of the station `car` and the gains of friction."""
        car = _in_floats(base_car(self.vehicle.build()))
        for name, effect in EFFECTS.items():
            values = tuple(one.value for one in self.vehicle.effects if one.effect == name)
            if values and (effect.station == "car" or name in GRIP):
                car = effect.apply(car, values)
        return _in_floats(car)

    @property
    def forces(self) -> tuple[float, float]:
        """Return the strongest brake force (negative) and drive force, after the gain of the drive [N]."""
        gain = 1 + self.value("drive_gain.p")
        return gain * self.vehicle.Fxr_min, gain * self.vehicle.Fxr_max

    @property
    def wheel_radius(self) -> float:
        """Return the rolling radius that a car of this size usually has [m]."""
        return WHEEL * (self.vehicle.a + self.vehicle.b)


class Format(NamedTuple):
    """Export target: title, effects that it can represent, and writer."""

    title: str
    holds: frozenset[str]
    notes: tuple[str, ...]  # how the target differs from any of these cars, and what was chosen for it
    write: Callable[[ReducedCar, Path], tuple[str, ...]]  # writes into a folder and returns the names of the files
    predicts: bool = True  # whether it is a model of motion, whose loss a prediction can measure


def _in_floats(car: CarParameters) -> Any:
    return jax.tree.map(float, car)


def restrict_effects(vehicle: VehicleConfig, holds: frozenset[str], options: TargetOptions) -> ReducedCar:
    """Reduce the car to the effects in `holds`."""
    effects = tuple(one for one in vehicle.effects if one.effect in holds)
    return ReducedCar(dataclasses.replace(vehicle, effects=effects, covariance=()), vehicle, options)


def car_with(vehicle: VehicleConfig, names: tuple[str, ...]) -> Universal:
    """Return the universal car with the named effects at the values that `vehicle` has; neutral where it has none."""
    effects, values = effects_by_name(names), {one.name: one.value for one in vehicle.effects}
    model = universal_car(vehicle, effects)
    parameters = [values.get(f"{effect.name}.{p.name}", 0.0) for effect in effects for p in effect.parameters]
    return model.with_parameters(jnp.asarray(parameters) / model.scale)


def save_text(path: Path, text: str) -> str:
    """Write a text file; return its name."""
    write_text(path, text)
    return path.name


def save_yaml(path: Path, content: dict) -> str:
    """Write a YAML file; return its name."""
    return save_text(path, yaml.safe_dump(content, sort_keys=False))
