"""Contents of a plant YAML file, validated, and the double-track car built from them."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from driftjax.core import require
from driftjax.tyre import MagicFormula, plant_tyre, read_tir
from driftjax.vehicle.actuators import Actuators
from driftjax.vehicle.double_track import DoubleTrack
from driftjax.vehicle.loads import Chassis
from driftjax.vehicle.wheels import Wheels

NON_NEGATIVE = ("h", "load_sensitivity", "carcass_time", "rolling_resistance", "drive_inertia", "diff_coupling",
                "diff_preload", "diff_bias", "drag", "roll_split")  # fmt: skip
T = TypeVar("T")
ANY_SIGN = ("name", "tyre", "E", "Fxr_min")


@dataclass(frozen=True)
class PlantConfig:
    """Parameters of the double-track plant."""

    name: str
    """Name of the plant, for titles and file names."""
    m: float
    """Mass [kg]."""
    Iz: float
    """Yaw moment of inertia [kg m^2]."""
    a: float
    """Distance from the centre of mass to the front axle [m]."""
    b: float
    """Distance from the centre of mass to the rear axle [m]."""
    h: float
    """Height of the centre of mass [m]; 0 switches load transfer off."""
    track_f: float
    """Front track width [m]."""
    track_r: float
    """Rear track width [m]."""
    roll_split: float
    """Share of the roll moment that the front axle takes, 0 to 1 [-]."""
    roll_lag: float
    """Time constant of the lateral load transfer [s]."""
    pitch_lag: float
    """Time constant of the longitudinal load transfer [s]."""
    drag: float
    """Aerodynamic drag over speed squared, rho CdA / 2 [N s^2/m^2]."""
    muf: float
    """Friction coefficient of the front tyres at their static load [-]."""
    mur: float
    """Friction coefficient of the rear tyres at their static load [-]."""
    Bf: float
    """Stiffness factor of the front tyres [1/rad]."""
    Br: float
    """Stiffness factor of the rear tyres [1/rad]."""
    C: float
    """Shape factor of the tyres [-]."""
    E: float
    """Curvature factor of the tyres, at most 1 [-]."""
    slip_ratio: float
    """Longitudinal over lateral slip stiffness [-]."""
    load_sensitivity: float
    """Relative loss of friction per relative increase of the load [-]."""
    relaxation: float
    """Lateral relaxation length [m]."""
    relaxation_long: float
    """Longitudinal relaxation length [m]."""
    carcass_time: float
    """Damping over stiffness of the tyre carcass [s]; damps the oscillation of the wheels near standstill."""
    wheel_radius: float
    """Rolling radius [m]."""
    wheel_inertia: float
    """Spin inertia of one wheel [kg m^2]."""
    drive_inertia: float
    """Spin inertia of motor and gear, reflected to the rear axle [kg m^2]."""
    rolling_resistance: float
    """Rolling resistance over load [-]."""
    diff_coupling: float
    """Viscous coupling of the rear wheels: 0 is open, large is locked [N m s/rad]."""
    diff_preload: float
    """Friction torque of the rear differential without drive [N m]."""
    diff_bias: float
    """Friction torque of the rear differential over the axle torque [-]."""
    diff_speed: float
    """Difference of the rear wheel speeds at which that friction is full [rad/s]."""
    steer_lag: float
    """Time constant of the steering [s]."""
    delta_max: float
    """Largest road-wheel angle, either side [rad]."""
    delta_rate_max: float
    """Largest steering rate [rad/s]."""
    drive_lag: float
    """Time constant of drive and brake [s]."""
    Fxr_min: float
    """Strongest braking force of the rear axle, negative [N]."""
    Fxr_max: float
    """Strongest driving force of the rear axle [N]."""
    Fxr_rate_max: float
    """Largest rate of that force [N/s]."""
    power_max: float
    """Largest driving power [W]."""
    creep_speed: float
    """Rim speed below which brake, rolling resistance and power limit fade [m/s]."""
    tyre: Path | None = None
    """Tyre property file (.tir), beside the YAML file, in place of Bf, Br, C, E, slip_ratio and load_sensitivity; muf
    and mur then scale its friction."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in NON_NEGATIVE:
                require(value >= 0, f"key '{name}' is {value}; it must not be negative.")
            elif name not in ANY_SIGN:
                require(value > 0, f"key '{name}' is {value}; it must be positive, in SI units and radians.")
        require(self.E <= 1, f"key 'E' is {self.E}; a curvature factor above 1 makes the force change sign.")
        require(self.C < 2, f"key 'C' is {self.C}; from 2 upwards the tyre would push; choose below 2.")
        require(self.Fxr_min <= 0, f"key 'Fxr_min' is {self.Fxr_min}; it brakes, so it must not be positive.")
        require(self.delta_max < 1.5, f"key 'delta_max' is {self.delta_max}; give radians below 1.5.")
        require(self.roll_split <= 1, f"key 'roll_split' is {self.roll_split}; it is a share of at most 1.")

    def build(self) -> DoubleTrack:
        """Build the double-track car."""

        def part(cls: type[T], **more: Any) -> T:
            """Build a part from the values of this file that have the names of its fields, and `more` ones."""
            names = [field.name for field in fields(cls) if field.name not in more]  # pyright: ignore[reportArgumentType]
            return cls(**{name: getattr(self, name) for name in names}, **more)

        mu, B = np.array([self.muf, self.muf, self.mur, self.mur]), np.array([self.Bf, self.Bf, self.Br, self.Br])
        wheels = part(Wheels, radius=self.wheel_radius, inertia=self.wheel_inertia)
        simple = lambda: part(MagicFormula, mu=mu, B=B)
        tyre = simple() if self.tyre is None else plant_tyre(read_tir(self.tyre), self.muf, self.mur)
        return DoubleTrack(part(Chassis), tyre, wheels, part(Actuators))
