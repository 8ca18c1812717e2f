"""Runs of the manoeuvre library on a car with a known truth, as a measurement would log them."""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import BadInput, require
from driftjax.environment import require_float64
from driftjax.logs import Run
from driftjax.manoeuvres.library import MANOEUVRES, RICH, vehicle_units
from driftjax.parallel import call
from driftjax.sim.log_flaws import Flaws, logged
from driftjax.sim.record import Conditions, Manoeuvre, Recording, record
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import EFFECTS
from driftjax.vehicle.single_track import G
from driftjax.vehicle.universal import universal_car

REDRAWS = 5  # how often a run that spins is drawn again
SLOWEST_RATE, FASTEST_RATE = 20.0, 1000.0  # of log and driver [Hz]
SPIN, SLOWEST = 1.2, 0.3  # a run is lost beyond this sideslip [rad], below this share of sqrt(g L)
STEP = 1e-3  # longest step of the plant [s]
PLACE = (0.007, 0.0035)  # typical noise of positions over the wheelbase, of the heading [rad]
ACCELERATION = 0.005  # typical noise of accelerations, over gravity [-]
LATER = 2**20  # offset of the seeds of runs driven after a campaign


@dataclass(frozen=True)
class Campaign:
    """Manoeuvres to drive, measurement noise and disturbances."""

    manoeuvres: tuple[str, ...] = RICH
    """Manoeuvres, one run each: drift, steady_drift, grip_sine, slalom, step_steer, throttle_steps, coast_down,
    laps."""
    duration: float = 10.0
    """Length of a run [s]."""
    rate: float = 100.0
    """Sample rate of the log and the driver [Hz]."""
    noise: float = 1.0
    """Sensor noise; 1 is typical: 0.05 m/s, 0.5 deg and 0.5 deg/s on a sedan [-]."""
    process_noise: float = 1.0
    """Disturbance of the car's motion; 1 is typical, 0 none [-]."""
    stochastic: bool = False
    """Disturb and measure with the noise that a diagnosis found (key `noise` of the car's file) in place of the typical
    one; `noise` and `process_noise` multiply it."""
    dropouts: float = 0.0
    """Share of samples in which V, beta and r are missing, some in a row [-]."""
    outliers: float = 0.0
    """Share of values of V, beta and r that are off by 10 to 30 times the typical noise [-]."""
    seed: int = 0
    """Seed of manoeuvres, noise, dropouts and outliers."""

    def __post_init__(self) -> None:
        require(len(self.manoeuvres) > 0, "key 'manoeuvres' is empty; name one at least.")
        for name in self.manoeuvres:
            require(name in MANOEUVRES, f"key 'manoeuvres' has '{name}'; choose from {', '.join(MANOEUVRES)}.")
        require(0.5 <= self.duration <= 600, f"key 'duration' is {self.duration}; it lies in 0.5..600 s.")
        slow, fast = SLOWEST_RATE, FASTEST_RATE
        require(slow <= self.rate <= fast, f"key 'rate' is {self.rate}; it lies in {slow:g}..{fast:g} Hz.")
        for name, most in (("noise", 20), ("process_noise", 20), ("dropouts", 0.5), ("outliers", 0.5)):
            value = getattr(self, name)
            require(0 <= value <= most, f"key '{name}' is {value}; it lies in 0..{most}.")
        require(self.seed >= 0, f"key 'seed' is {self.seed}; it must not be negative.")


@dataclass(frozen=True, eq=False)
class Truth:
    """Truth of a simulated log: effects, noise and states."""

    effects: dict[str, dict[str, float]]
    """Parameters that are not neutral, SI."""
    noise: dict[str, float]
    """Standard deviation of measured V [m/s], beta [rad], r [rad/s]."""
    process_noise: dict[str, float]
    """That of rates added to those of V [m/s^2], beta [rad/s], r [rad/s^2], and their correlation time [s]."""
    left_out: tuple[str, ...]
    """Runs in which the car spun or came to a stop every time."""
    states: dict[str, Float[np.ndarray, "T 3"]]
    """True V, beta, r of each run."""


def typical_conditions(vehicle: VehicleConfig, noise: float = 1.0, process_noise: float = 1.0) -> Conditions:
    """Return the noise and disturbance of a car, as multiples of the typical ones."""
    unit = vehicle_units(vehicle)
    sigma = noise * np.array([0.0092 * unit.speed, 0.0087, 0.0049 / unit.time])
    rates = process_noise * np.array([0.0092 * unit.speed / unit.time, 0.0084 / unit.time, 0.028 / unit.time**2])
    slow = jnp.zeros(3), jnp.ones(())
    return Conditions(jnp.asarray(sigma), jnp.asarray(rates), jnp.asarray(0.54 * unit.time), *slow)


def estimated_conditions(vehicle: VehicleConfig, noise: float = 1.0, process_noise: float = 1.0) -> Conditions:
    """Return the noise and disturbance that a diagnosis estimated, as multiples; `BadInput` without them."""
    estimate = vehicle.noise
    if estimate is None:
        raise BadInput(
            f"vehicle {vehicle.name}: its file has no key 'noise', which stochastic runs need; give the extended.yaml "
            "of a diagnosis."
        )
    row = lambda channels: jnp.asarray([channels.V, channels.beta, channels.r])
    slow = noise * row(estimate.slow_sigma), jnp.asarray(estimate.slow_correlation_s)
    correlation = jnp.asarray(estimate.process_correlation_s)
    return Conditions(noise * row(estimate.sigma), process_noise * row(estimate.process_sigma), correlation, *slow)


def campaign_conditions(vehicle: VehicleConfig, campaign: Campaign) -> Conditions:
    """Return the noise and disturbance of the runs of a campaign."""
    source = estimated_conditions if campaign.stochastic else typical_conditions
    return source(vehicle, campaign.noise, campaign.process_noise)


def drive_manoeuvre(
    vehicle: VehicleConfig, theta: Array, manoeuvre: Manoeuvre, conditions: Conditions, seed: Array, dt: float
) -> Recording:
    """Drive one manoeuvre with the noise of its seed; samples every `dt` [s]."""
    plant = universal_car(vehicle, tuple(EFFECTS.values())).with_parameters(theta)
    substeps = max(round(dt / STEP), 1)
    return record(plant, vehicle, manoeuvre, conditions, jax.random.key(seed), dt, substeps)


def record_runs(vehicle: VehicleConfig, theta: np.ndarray, campaign: Campaign) -> tuple[tuple[Run, ...], Truth]:
    """Drive a campaign on `vehicle` with effects `theta` (K,) (`effect_strengths`); return logged runs and the truth.

    `theta` holds all effects that act, those of an extended `vehicle` among them, in typical sizes. A run that spins is
    drawn again `REDRAWS` times, then left out. Runs are driven one by one, so that one program serves any number of
    them; another run length or car compiles again.
    """
    require_float64()
    t, dt = np.arange(round(campaign.duration * campaign.rate)) / campaign.rate, 1 / campaign.rate
    conditions = campaign_conditions(vehicle, campaign)
    vehicle = dataclasses.replace(vehicle, noise=None, effects=(), covariance=())  # no part of the program
    flaws, runs, states, left_out = log_flaws(vehicle, campaign), [], {}, []
    for i, kind in enumerate(campaign.manoeuvres):
        name, rng = f"{kind}-{i + 1}", np.random.default_rng((campaign.seed, i))
        for _ in range(1 + REDRAWS):
            manoeuvre, seed = jax.tree.map(  # arrays of no weak type: one compile
                lambda a: jnp.asarray(np.asarray(a)),
                (MANOEUVRES[kind](vehicle, rng, t), rng.integers(2**32, dtype=np.uint32)),
            )
            one = call(drive_manoeuvre, vehicle, jnp.asarray(theta), manoeuvre, conditions, seed, dt)
            if not is_lost(vehicle, one):
                runs.append(logged(name, one, float(manoeuvre.lap), dt, flaws, rng))
                states[name] = np.asarray(one.x)
                break
        else:
            left_out.append(name)
    return tuple(runs), _truth(vehicle, theta, conditions, tuple(left_out), states)


def log_flaws(vehicle: VehicleConfig, campaign: Campaign) -> Flaws:
    """Return dropouts, outliers and noise of the logs of a campaign, in units of the car."""
    metres, heading = campaign.noise * PLACE[0] * vehicle_units(vehicle).length, campaign.noise * PLACE[1]
    sigma, acceleration = np.asarray(typical_conditions(vehicle).sigma), campaign.noise * ACCELERATION * G
    return Flaws(campaign.dropouts, campaign.outliers, sigma, metres, heading, acceleration)


def is_lost(vehicle: VehicleConfig, recording: Recording) -> bool:
    """Return whether the car spun, stopped or reached states that are not finite."""
    x = np.asarray(recording.x)
    held = np.isfinite(recording.y).all() and np.abs(x[:, 1]).max() <= SPIN
    return not (held and x[:, 0].min() >= SLOWEST * vehicle_units(vehicle).speed)


def _truth(vehicle: VehicleConfig, theta: np.ndarray, conditions: Conditions, left_out: tuple, states: dict) -> Truth:
    each = [(effect.name, p.name, p.scale(vehicle)) for effect in EFFECTS.values() for p in effect.parameters]
    effects: dict[str, dict[str, float]] = {}
    for (effect, name, scale), strength in zip(each, theta, strict=True):
        if strength:
            effects.setdefault(effect, {})[name] = float(f"{strength * scale:.12g}")
    short = lambda names, values: {name: float(f"{value:.6g}") for name, value in zip(names, values, strict=True)}
    rates = short(("V", "beta", "r", "correlation"), (*conditions.disturbance, conditions.correlation))
    return Truth(effects, short(("V", "beta", "r"), conditions.sigma), rates, left_out, states)
