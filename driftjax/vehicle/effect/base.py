"""What an effect is: one missing physics with its parameters, and the station of the car where it acts."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Literal

from driftjax.vehicle.parameters import VehicleConfig
from driftjax.vehicle.single_track import G

Station = Literal["command", "car", "slip", "load", "friction", "force", "sensor"]
Scale = Literal["1", "length", "time", "speed", "force", "moment", "mass", "drag", "yaw_rate", "yaw_damping",
                "per_time", "per_force", "per_power", "per_acceleration"]  # fmt: skip


def reference(vehicle: VehicleConfig, of: Scale) -> float:
    """The quantity of a car that makes a parameter dimensionless, SI: wheelbase, weight, sqrt(L/g) and so on."""
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
    """One number of an effect. Its neutral value is 0: there the car is exactly the nominal one."""

    name: str
    unit: str
    typical: float
    """Size met in practice, over `reference(vehicle, of)`; what a fit is scaled with."""
    of: Scale = "1"
    lower: float = -4.0
    """Smallest value, in typical sizes; 0 for what cannot be negative, such as a lag."""
    upper: float = 4.0
    """Largest value, in typical sizes."""

    @property
    def suffix(self) -> str:
        """Unit as it follows a number in text; nothing for a pure number."""
        return "" if self.unit == "1" else f" {self.unit}"

    def scale(self, vehicle: VehicleConfig) -> float:
        """Typical size on this car, SI."""
        return self.typical * reference(vehicle, self.of)

    def bounds(self, vehicle: VehicleConfig) -> tuple[float, float]:
        """Smallest and largest value on this car, SI."""
        scale = self.scale(vehicle)
        return self.lower * scale, self.upper * scale


def no_memory(dt: float) -> tuple[()]:
    """Of an effect that has none."""
    return ()


@dataclass(frozen=True)
class Effect:
    """One missing physics. `apply` takes what has been computed up to its station and hands it on changed.

    | station | `apply` | takes and returns |
    |---|---|---|
    | command | `(memory, u, V, dt, p) -> (memory, u)`, `start(dt) -> memory` | `Control` over one step |
    | car | `(car, p) -> car` | `Car` |
    | slip, load, friction, force | `(flow, p) -> flow` | `Flow` |
    | sensor | `(x, dx, p) -> x` | `State` and its rate, as the sensors tell them |

    `p` is a tuple with one scalar per parameter, SI.
    """

    name: str
    number: int
    station: Station
    parameters: tuple[Parameter, ...]
    apply: Callable[..., Any]
    source: str
    sentence: str
    """What is said of it when it is found, without its numbers."""
    kinematic: bool = False
    """Whether it shows in kinematic parity (sensors and road), not only in the forces (physics of the car)."""
    needs: tuple[str, ...] = ()
    """Log columns without which it cannot be told: `psi` or `s`."""
    transient: bool = False
    """Whether it acts by what went before, beyond the state and the memory of a command: rates at rest are nominal."""
    start: Callable[[float], Any] = no_memory
    """Memory of a command effect at rest."""
    sensor_delay: bool = False
    """Whether its three parameters are delays of V, beta and r [s]: `apply` is exact for those of less than a step."""

    def __repr__(self) -> str:
        """Fields, this package's own functions by name: without addresses a compiled program can be kept."""
        return f"Effect({', '.join(f'{field.name}={_named(getattr(self, field.name))}' for field in fields(self))})"


def _named(value: Any) -> str:
    own = callable(value) and value.__module__.startswith(f"{__name__.partition('.')[0]}.")
    return f"{value.__module__}.{value.__qualname__}" if own and "<" not in value.__qualname__ else repr(value)
