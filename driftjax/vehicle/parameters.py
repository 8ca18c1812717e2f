"""Validated parameters of a car, and the nominal car built from them."""

from dataclasses import dataclass, replace

import numpy as np

from driftjax.core import require
from driftjax.tyre import SimplifiedPacejka
from driftjax.vehicle.single_track import SingleTrack


@dataclass(frozen=True)
class EffectParameterValue:
    """Value of one parameter of an effect named by a diagnosis, SI."""

    effect: str
    parameter: str
    value: float
    ci95_half: float | None = None
    """Half-width of its 95 % interval; None where the file gives none."""

    @property
    def name(self) -> str:
        """Return the qualified name `effect.parameter`, as on the command line of `driftjax simulate`."""
        return f"{self.effect}.{self.parameter}"


@dataclass(frozen=True)
class PerChannel:
    """One standard deviation for each measured channel, SI."""

    V: float
    """Of the speed [m/s], or of its rate [m/s^2]."""
    beta: float
    """Of the sideslip [rad], or of its rate [rad/s]."""
    r: float
    """Of the yaw rate [rad/s], or of its rate [rad/s^2]."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require(value >= 0, f"key '{name}' is {value}; a standard deviation must not be negative.")


@dataclass(frozen=True)
class EstimatedNoise:
    """Noise that a diagnosis or calibration estimated: the part that no effect of the catalogue explains."""

    sigma: PerChannel
    """Standard deviation of the white errors of the measured V, beta, r."""
    process_sigma: PerChannel
    """Standard deviation of the disturbance that is added to the rates of V, beta, r."""
    process_correlation_s: float
    """Correlation time of this disturbance [s]."""
    slow_sigma: PerChannel = PerChannel(0.0, 0.0, 0.0)
    """Standard deviation of the slow errors of the measured V, beta, r."""
    slow_correlation_s: float = 1.0
    """Correlation time of these errors [s]."""

    def __post_init__(self) -> None:
        for name in ("process_correlation_s", "slow_correlation_s"):
            require(getattr(self, name) > 0, f"key '{name}' is {getattr(self, name)}; it must be positive.")


@dataclass(frozen=True)
class VehicleConfig:
    """Parameters of the nominal car and its command limits (Wu et al. 2025, Tables II and III), and named effects."""

    name: str
    """Name of the car, for titles and file names."""
    m: float
    """Mass [kg]."""
    Iz: float
    """Yaw moment of inertia [kg m^2]."""
    a: float
    """Distance from the centre of mass to the front axle [m]."""
    b: float
    """Distance from the centre of mass to the rear axle [m]."""
    mu: float
    """Friction coefficient [-]."""
    B: float
    """Stiffness factor of the tyre [1/rad]."""
    C: float
    """Shape factor of the tyre [-]."""
    width: float
    """Overall width [m]: the track has to be wider."""
    length: float
    """Overall length [m], for drawing."""
    delta_max: float
    """Largest steering angle, either side [rad]."""
    delta_rate_max: float
    """Largest steering rate [rad/s]."""
    Fxr_min: float
    """Smallest rear longitudinal force [N]; negative brakes."""
    Fxr_max: float
    """Largest rear longitudinal force [N]."""
    Fxr_rate_max: float
    """Largest rate of the rear longitudinal force [N/s]."""

    combined_slip: float = 0.0
    """How much the drive force takes from the rear lateral force: 0 as published, 1 a friction circle [-]."""
    effects: tuple[EffectParameterValue, ...] = ()
    """What a diagnosis named, all parameters of an effect, in the catalogue's order: see `load_vehicle`."""
    covariance: tuple[tuple[float, ...], ...] = ()
    """Covariance of the values of `effects`, in their order, SI; empty where the file gives none."""
    noise: EstimatedNoise | None = None
    """Noise that a diagnosis found; None where the file gives none."""

    def __post_init__(self) -> None:
        require(0 <= self.combined_slip <= 1.5, f"key 'combined_slip' is {self.combined_slip}; it lies in 0..1.5.")
        for name in ("m", "Iz", "a", "b", "mu", "B", "C", "width", "length", "delta_max", "delta_rate_max",
                     "Fxr_max", "Fxr_rate_max"):  # fmt: skip
            value = getattr(self, name)
            require(value > 0, f"key '{name}' is {value}; it must be positive, in SI units and radians.")
        require(self.C > 1, f"key 'C' is {self.C}; a drift needs a tyre with a peak, so C must exceed 1.")
        require(self.Fxr_min < self.Fxr_max, f"key 'Fxr_min' is {self.Fxr_min}; it must be below 'Fxr_max'.")
        require(self.delta_max < 1.5, f"key 'delta_max' is {self.delta_max}; give radians below 1.5.")

    def build(self) -> SingleTrack:
        """Build the nominal car, without the named effects: `build_car` adds them."""
        tyre = SimplifiedPacejka(self.mu, self.B, self.C)
        return SingleTrack(self.m, self.Iz, self.a, self.b, tyre, self.combined_slip)

    def command_limits(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the lower and upper limit (2,) of steering [rad] and drive [N], and the rate limit [per second]."""
        lower = np.array([-self.delta_max, self.Fxr_min])
        upper = np.array([self.delta_max, self.Fxr_max])
        return lower, upper, np.array([self.delta_rate_max, self.Fxr_rate_max])

    def with_combined_slip(self, combined_slip: float | None) -> "VehicleConfig":
        """Return this car with another friction ellipse; None is a friction circle, except for an extended car.

        An extended car then stays as it is: its effects are differences to the nominal car they were identified with,
        ellipse included.
        """
        if combined_slip is None:
            return self if self.effects else replace(self, combined_slip=1.0)
        return replace(self, combined_slip=combined_slip)
