"""Definition of an effect: one physical mechanism with its parameters, and the station of the car where it acts."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from types import FunctionType
from typing import Any, Literal

from driftjax.vehicle.effect.families import FAMILY_OF
from driftjax.vehicle.parameters import VehicleConfig
from driftjax.vehicle.single_track import G

Station = Literal["command", "car", "slip", "load", "friction", "force", "sensor"]
Scale = Literal["1", "length", "time", "speed", "force", "moment", "mass", "drag", "yaw_rate", "yaw_damping",
                "per_time", "per_force", "per_power", "per_acceleration"]  # fmt: skip


def reference(vehicle: VehicleConfig, of: Scale) -> float:
    """Return the quantity that makes a parameter dimensionless, SI: wheelbase, weight, sqrt(L/g) and so on."""
    length, time = vehicle.a + vehicle.b, ((vehicle.a + vehicle.b) / G) ** 0.5
    weight = vehicle.m * G
    return {
        "1": 1.0,
        "length": length,
        "time": time,
        "speed": length / time,
        "force": weight,
        "moment": weight * length,
        "mass": vehicle.m,
        "drag": vehicle.m / length,  # N per (m/s)^2
        "yaw_rate": 1 / time,
        "yaw_damping": weight * length * time,  # N m per rad/s
        "per_time": 1 / time,
        "per_force": 1 / weight,
        "per_power": time / (weight * length),
        "per_acceleration": 1 / G,
    }[of]


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect. Its neutral value is 0: there the car is exactly the nominal one."""

    name: str
    unit: str
    typical: float
    """Typical size in practice over `reference(vehicle, of)`; scales the fit."""
    of: Scale = "1"
    lower: float = -4.0
    """Smallest value, in typical sizes; 0 for what cannot be negative, such as a lag."""
    upper: float = 4.0
    """Largest value, in typical sizes."""
    optional: bool = False
    """Whether files may leave it out, as those from before it was known do; it is neutral there."""

    @property
    def suffix(self) -> str:
        """Return the unit as printed after a number; empty for a pure number."""
        return "" if self.unit == "1" else f" {self.unit}"

    def scale(self, vehicle: VehicleConfig) -> float:
        """Return the typical size on this car, SI."""
        return self.typical * reference(vehicle, self.of)

    def bounds(self, vehicle: VehicleConfig) -> tuple[float, float]:
        """Return the lower and upper bound on this car, SI."""
        scale = self.scale(vehicle)
        return self.lower * scale, self.upper * scale


def no_memory(dt: float) -> tuple[()]:
    """Return the memory of an effect without memory."""
    return ()


@dataclass(frozen=True)
class Effect:
    """One physical mechanism that the nominal car lacks. `apply` maps the inputs of its station to outputs.

    | station | `apply` | input and output |
    |---|---|---|
    | command | `(memory, u, V, dt, p) -> (memory, u)`, `start(dt) -> memory` | `Control` over one step |
    | car | `(car, p) -> car` | `CarParameters` |
    | slip, load, friction, force | `(flow, p) -> flow` | `Flow` |
    | sensor | `(x, dx, p) -> x` | measured `State`, and its rate |

    `p` is a tuple with one scalar per parameter, SI.
    """

    name: str
    number: int
    station: Station
    parameters: tuple[Parameter, ...]
    apply: Callable[..., Any]
    source: str
    sentence: str
    """Description in reports, without its numbers."""
    kinematic: bool = False
    """Whether it affects kinematic parity (sensors and road), not only the forces (physics of the car)."""
    needs: tuple[str, ...] = ()
    """Log columns that it needs: `psi` or `s`."""
    transient: bool = False
    """Whether it depends on the past beyond state and command memory; steady-state rates are nominal."""
    reads_acceleration: bool = False
    """Whether it depends on `Flow.ax`, `ay` or the roll, which are computed, at some cost, only where one does."""
    start: Callable[[float], Any] = no_memory
    """Memory of a command effect at rest."""
    sensor_delay: bool = False
    """Whether its three parameters are delays of V, beta and r [s]: `apply` is exact for those of less than a step."""
    on_request: bool = False
    """Whether a diagnosis includes it only when its name is given."""
    equation: str = ""
    """Equation and remarks; those of the module's docstring where left out."""

    @property
    def family(self) -> str:
        """Return the part of the car or of the measurement that it belongs to, such as "steering" or "sensor"."""
        return FAMILY_OF[self.name]

    @property
    def formula(self) -> str:
        """Return the equation that its parameters stand in, with remarks and source."""
        module = sys.modules[self.apply.__module__].__doc__ or ""
        return f"{self.equation} ({self.source})." if self.equation else module.strip()

    def __repr__(self) -> str:
        """Return the fields, own functions by name: without addresses compiled programs can be reused."""
        return f"Effect({', '.join(f'{field.name}={_named(getattr(self, field.name))}' for field in fields(self))})"


def _named(value: Any) -> str:
    own = isinstance(value, FunctionType) and value.__module__.startswith(f"{__name__.partition('.')[0]}.")
    return f"{value.__module__}.{value.__qualname__}" if own and "<" not in value.__qualname__ else repr(value)
