"""Options of the minimum-time planner."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from driftjax.core import find_config, from_dict, read_yaml, require, require_at_least, require_positive
from driftjax.core.config import to_dict
from driftjax.vehicle import VehicleConfig


@dataclass(frozen=True)
class PlanConfig:
    """Options of the minimum-time planner; SI and radians. The defaults suit the sedan."""

    entry_speed: float = 12.31
    """Speed at the start, where the car rolls straight along the centre line [m/s]."""
    V_fair: float | None = None
    """Speed from which going faster saves hardly any time [m/s]; omitted: no limit. Smooth, unlike `V_max`."""
    num_nodes: int | None = None
    """Nodes along the track, both ends included; left out: 0.15 wheelbases apart, but at least 301."""
    V_min: float = 3.0
    """Smallest speed allowed [m/s]."""
    V_max: float = 40.0
    """Largest speed allowed [m/s]."""
    margin: float = 0.0
    """Distance kept between the side of the car and the border, beside half its width [m]."""
    beta_max: float = 0.9
    """Largest sideslip in a drift, either side [rad]."""
    beta_normal: float = 0.15
    """Largest sideslip elsewhere [rad]: without it this model brakes sideways on the straights."""
    end_slip: float = 0.1
    """Largest sideslip, and angle between course and track, at the end [rad]."""
    drift: bool = True
    """Whether tight corners must be drifted: at minimum time this model grips unless constrained to drift."""
    beta_d: float = 0.349066
    """Least sideslip that the drift device requires, out of the corner [rad]."""
    drift_radius: float = 18.0
    """Corners tighter than this radius are drifted [m]."""
    drift_angle: float = 1.2
    """Heading that such a corner must turn at least to be drifted [rad]."""
    drift_from: float = 0.0
    """Where the device begins to rise, as a share of the tight part of the corner [-]."""
    drift_to: float = 1.0
    """Where the device has fallen to zero, as a share of the tight part of the corner [-]."""
    drift_ramp: float = 0.15
    """Length over which the device rises to beta_d, and later falls, as a share of the tight part [-]."""
    drift_reach: float = 0.35
    """How far before and after the tight part the car may be sideways, as a share of it [-]."""
    label_beta: float = 0.15
    """Sideslip, opposite in sign to the yaw rate, from which a node is labelled a drift [rad]."""
    rate_weight: float = 0.002
    """Cost in seconds per second of full steering rate, and of full force rate: keeps the inputs smooth [-]."""
    course_weight: float = 0.0
    """Cost in seconds per second and squared radian between course and track: prevents weaving on straights."""
    front_slip: float = 0.0
    """Cost in seconds per second and squared radian of front slip beyond the tyre's peak: without it a plan may brake
    by a saturated front, which no controller can steer from."""
    friction_share: float = 1.0
    """Friction that the plan may use, over the nominal car's [-]: leaves room to drift where grip would do."""
    combined_slip: float = 0.0
    """Friction ellipse of the planner's car, as in a vehicle YAML: without one a plan asks for drive force and side
    force that no tyre gives at once [-]."""
    brake_share: float = 1.0
    """Braking force that the plan may use, over the car's [-]."""
    steer_share: float = 1.0
    """Steering angle that the plan may use, over the car's [-]: the rest is reserved for catching a slide."""
    lead: float = 0.15
    """Least run-up and run-out together around the lap of a closed track, as a share of the lap [-]."""
    tolerance: float = 1e-6
    """On the solver's scaled KKT residual and constraint violation [-]."""
    max_steps: int = 1000
    """Solver iterations allowed."""

    def __post_init__(self) -> None:
        require_positive(self, "entry_speed", "V_fair", "V_min", "V_max", "beta_max", "beta_normal", "end_slip",
                         "drift_radius", "drift_ramp", "friction_share", "steer_share", "tolerance")  # fmt: skip
        require_at_least(self, 0, "margin", "beta_d", "drift_angle", "drift_reach", "label_beta", "rate_weight",
                         "course_weight", "front_slip", "brake_share")  # fmt: skip
        require_at_least(self, 20, "num_nodes")
        require_at_least(self, 1, "max_steps")
        require(0 < self.lead <= 0.9, f"key 'lead' is {self.lead}; give a share of the lap up to 0.9.")
        require(self.V_min < self.V_max, f"key 'V_min' is {self.V_min}; it must be below 'V_max'.")
        require(self.beta_max < 1.4, f"key 'beta_max' is {self.beta_max}; give radians below 1.4.")
        require(self.beta_normal <= self.beta_max, f"key 'beta_normal' is {self.beta_normal}; it exceeds 'beta_max'.")
        require(self.beta_d < self.beta_max, f"key 'beta_d' is {self.beta_d}; it must be below 'beta_max'.")
        ordered = 0 <= self.drift_from < self.drift_to - 2 * self.drift_ramp and self.drift_to <= 1
        require(ordered, "keys 'drift_from' and 'drift_to' must lie in 0..1, with room between them for two ramps.")

    def planned(self, vehicle: VehicleConfig) -> VehicleConfig:
        """Return the car as the planner may use it; a named friction ellipse is known and unchanged."""
        brake = self.brake_share * vehicle.Fxr_min
        known = any(one.effect == "combined_slip" for one in vehicle.effects)
        return dataclasses.replace(
            vehicle,
            mu=self.friction_share * vehicle.mu,
            Fxr_min=brake,
            delta_max=self.steer_share * vehicle.delta_max,
            combined_slip=vehicle.combined_slip if known else max(self.combined_slip, vehicle.combined_slip),
        )


def load_plan_config(name: str | Path, car: str = "sedan") -> PlanConfig:
    """Load options of the planner: a shipped name (`sedan`, `rc`, `dart`), or a YAML of what differs from its car's.

    A YAML names its car by the key `car`; without it, it is `car`.
    """
    path = find_config("plan", name)
    return complete_plan_config({"car": car} | read_yaml(path), str(path))


def complete_plan_config(options: dict[str, Any], where: str) -> PlanConfig:
    """Complete `options` of the planner by the shipped ones of the car that they name; `where` names them in errors."""
    path = find_config("plan", str(options.get("car", "sedan")))
    shipped = from_dict(PlanConfig, _without_car(read_yaml(path)), str(path))
    return from_dict(PlanConfig, to_dict(shipped) | _without_car(options), where)


def _without_car(options: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in options.items() if key != "car"}
