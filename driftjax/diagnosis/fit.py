"""Problems and hypotheses: the cost of parameters by the observer's innovations, and its derivatives."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from numpy.lib.stride_tricks import sliding_window_view

from driftjax.core import BadInput
from driftjax.diagnosis.acceleration import with_inertial_force
from driftjax.diagnosis.channel_estimates import TURNED, has_force
from driftjax.diagnosis.motion import (
    MotionNoise,
    estimate_motion_noise,
    whitened_motion_derivatives,
    whitened_residuals,
)
from driftjax.diagnosis.noise import (
    CORRELATION,
    FIRST_DISTURBANCE,
    FIRST_SLOW,
    PRIOR,
    SILENT_DISTURBANCE,
    SLOW_CORRELATION,
    estimate_noise,
    measured_channels,
    measurement_noise,
    observed_channels,
)
from driftjax.diagnosis.noise_model import Noise
from driftjax.diagnosis.observer import Gains, Path, samples_in_run
from driftjax.diagnosis.runs import (
    Linearisation,
    Pieces,
    differentiate,
    fixed_gain,
    observer_gains,
    pieces,
    run_observer,
    run_observers,
    step_derivatives,
    take,
    whiten,
    with_likeliest_start,
)
from driftjax.logs import Run
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import Effect
from driftjax.vehicle.effect.families import DRIVE, FAMILY_OF
from driftjax.vehicle.single_track import G
from driftjax.vehicle.universal import Universal, universal_car

MOST_ROWS = 512  # pieces times hypotheses evaluated together: those of a long log fill the memory
STABILITY_LIMIT = 2.5  # decay over a step that the Runge-Kutta method bears: 2.78
GYRO = ("gyro_bias", "gyro_scale")  # errors that the rate of a heading does not have
BY_FORCE = ("traction_limit", "combined_slip", "load_transfer_long")  # effects that only a force shows
LOST = 100.0  # largest derivative in a piece over the median of all pieces, from which the observer has lost the car
LOST_LIMITS = (1e3, 1e8)  # whatever that median, in noise per typical size
MOST_LOST = 0.5  # share of the time in which it may lose the car


class Problem(NamedTuple):
    """Data and model of one diagnosis, with the noise and the observer gains."""

    model: Universal
    data: Pieces
    lower: np.ndarray  # (K,) bounds of theta, in typical sizes
    upper: np.ndarray
    start: np.ndarray  # (K,) theta of the nominal car, 0 but for the effects that its file names already
    owner: np.ndarray  # (K,) index of the effect that a parameter belongs to
    extra_columns: frozenset[str]  # further columns that every run has
    active: np.ndarray  # (K,) whether the parameter is in question: others stay where they start
    noise: Noise
    gains: Gains
    motion: MotionNoise | None = None  # of pose and accelerations, where these count
    precision: np.ndarray | None = None  # (K, K) of the Gaussian prior about `start`; None: of `PRIOR` alone

    @property
    def prior(self) -> np.ndarray:
        """Return the precision (K, K) of the Gaussian prior about `start`."""
        return np.eye(len(self.owner)) / PRIOR**2 if self.precision is None else self.precision

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return the catalogue, in the order of `owner`."""
        return self.model.effects

    @property
    def measured(self) -> np.ndarray:
        """Return which of V, beta, r (3,) predictions can be compared with."""
        return observed_channels(np.asarray(self.data.padded.valid), self.data.informative)

    @property
    def unidentifiable_effects(self) -> tuple[int, ...]:
        """Return the effects that are not identifiable because the force was estimated."""
        return () if self.data.force_known else tuple(i for i, e in enumerate(self.effects) if depends_on_force(e))

    def columns(self, selected: tuple[int, ...]) -> np.ndarray:
        """Return the parameter indices of the effects `selected`."""
        return np.flatnonzero(np.isin(self.owner, selected))

    def subset(self, runs: np.ndarray) -> "Problem":
        """Return the problem restricted to the runs with these numbers."""
        keep = np.flatnonzero(np.isin(self.data.run, runs))
        return self._replace(data=self.data.subset(keep), gains=take(self.gains, keep), motion=None)

    @property
    def num_measurements(self) -> int:
        """Return the number of measurements in the cost."""
        windows = 0 if self.motion is None else self.motion.used.sum()
        return int(np.sum(np.asarray(self.data.padded.valid) * self.data.informative) + windows)


class Fit(NamedTuple):
    """Fit of one hypothesis."""

    theta: np.ndarray  # (K,) in typical sizes
    cost: float  # sum of squares of whitened innovations, prior included
    e: np.ndarray  # (P, T, c) whitened innovations of V, beta, r, and residuals of pose and accelerations if they count
    path: Path | None = None  # of the observer (P, T, ...), where known


def initial_problem(
    vehicle: VehicleConfig, effects: tuple[Effect, ...], runs: tuple[Run, ...], without: tuple[str, ...] = ()
) -> Problem:
    """Build the problem with an initial guess of the noise and first observer gains.

    Effects `without` which the search is done keep their start values, as do those whose columns or sensor a run lacks
    and, where the force is not known, those that depend on it.
    """
    data = measured_pieces(vehicle, runs)
    known = data.force_known
    model = universal_car(vehicle, effects, stable_substeps(vehicle, runs), by_acceleration=not known)
    start = initial_theta(vehicle, model)
    has = frozenset.intersection(*(frozenset(run.extra) for run in runs))
    parameters = [(i, p) for i, effect in enumerate(effects) for p in effect.parameters]
    judged = lambda one: known or not depends_on_force(one)
    fixed = {*without, *(() if data.yaw_rate_measured else GYRO)}
    places = has | {"psi"} if TURNED in has else has
    searched = [one.name not in fixed and set(one.needs) <= places and judged(one) for one in effects]
    active = np.array([searched[i] for i, _ in parameters])
    lower, upper = (np.array([getattr(p, side) for _, p in parameters], float) for side in ("lower", "upper"))
    owner, gains = np.array([i for i, _ in parameters]), fixed_gain(data)
    problem = Problem(model, data, lower, upper, start, owner, has, active, initial_noise(data), gains)
    return with_first_gains(problem, start)


def depends_on_force(effect: Effect) -> bool:
    """Return whether an effect changes the drive force, so that an estimated force absorbs it."""
    return FAMILY_OF[effect.name] == DRIVE or effect.name in BY_FORCE


def measured_pieces(vehicle: VehicleConfig, runs: tuple[Run, ...]) -> Pieces:
    """Cut runs into pieces; where one lacks the drive force, accelerations stand for it in all of them.

    The smoothed speed is beside the commands then. Speeds as measured stay among the measurements, for what pose and
    accelerations are compared with.
    """
    if all(map(has_force, runs)):
        return pieces(vehicle, runs)
    driven = with_inertial_force(vehicle, runs)
    data = pieces(vehicle, tuple(dataclasses.replace(run, Fxr=one.Fxr) for run, one in zip(runs, driven, strict=True)))
    smooth = pieces(vehicle, driven).padded
    return data._replace(padded=data.padded._replace(V=smooth.V), force_known=False)


def stable_substeps(vehicle: VehicleConfig, runs: tuple[Run, ...]) -> int:
    """Return the integration steps per sample that are stable at the slowest speed of `runs`, outliers excluded.

    On straight road sideslip and yaw rate of a car with the tyres' initial stiffness decay with these rates. A few slow
    samples are enough for an unstable step to diverge, however fast the rest is.
    """
    V = min(slowest_speed(run.V) for run in runs)
    stiffness = vehicle.mu * vehicle.B * vehicle.C * G / max(V, 0.1 * np.sqrt(G * (vehicle.a + vehicle.b)))
    fastest = stiffness * max(1.0, vehicle.m * vehicle.a * vehicle.b / vehicle.Iz)
    return max(int(np.ceil(runs[0].dt * fastest / STABILITY_LIMIT)), 1)


def slowest_speed(V: np.ndarray) -> float:
    """Return the least median of three samples in a row of the speeds `V` (n,) that were measured [m/s]."""
    V = V[np.isfinite(V)]
    return float(np.median(sliding_window_view(V, 3), axis=1).min()) if len(V) > 2 else float(V.min(initial=np.inf))


def initial_theta(vehicle: VehicleConfig, model: Universal) -> np.ndarray:
    """Return theta (K,) of the effects in the file of `vehicle`."""
    values = {(one.effect, one.parameter): one.value for one in vehicle.effects}
    each = [(effect.name, p.name) for effect in model.effects for p in effect.parameters]
    lost = sorted({effect for effect, _ in values} - {effect for effect, _ in each})
    if lost:
        raise BadInput(f"vehicle '{vehicle.name}' has the effects {', '.join(lost)}, which this catalogue lacks.")
    return np.array([values.get(key, 0.0) for key in each]) / np.asarray(model.scale)


def initial_noise(data: Pieces) -> Noise:
    """Return the noise assumed before any model is fitted."""
    valid = np.asarray(data.padded.valid)
    sigma = measurement_noise(np.asarray(data.padded.y), valid)
    disturbance = np.where(measured_channels(valid), FIRST_DISTURBANCE, SILENT_DISTURBANCE) * sigma
    return Noise(sigma, disturbance, CORRELATION, FIRST_SLOW * sigma, SLOW_CORRELATION)


def with_estimated_noise(problem: Problem, theta: np.ndarray, profiled: np.ndarray) -> Problem:
    """Return the problem with the noise estimated for the car `theta`, and gains along its path.

    What parameters that are `profiled` (K,) out could explain is not taken for noise.
    """
    first = with_first_gains(problem, theta)
    model, data = first.model, first.data
    path = run_observer(model, data, theta, first.gains)
    steps = step_derivatives(model, data, theta, path, profiled)
    noise = estimate_noise(steps, path.e, first.gains, first.noise, data.dt, data.informative)
    return with_noise(with_motion_noise(first), theta, noise)


def with_first_gains(problem: Problem, theta: np.ndarray) -> Problem:
    """Return the problem with the noise assumed at first: fixed gains, or those of the extended filter of `theta`."""
    guess = initial_noise(problem.data)
    if problem.data.skip:
        return with_noise(problem, theta, guess)
    return problem._replace(noise=guess, gains=fixed_gain(problem.data))


def with_motion_noise(problem: Problem) -> Problem:
    """Add the residuals of pose and accelerations, if measured, with their estimated noise.

    That noise depends on no car: a problem that has it keeps it.
    """
    data, limits = problem.data, (problem.lower, problem.upper)
    if data.motion is None or problem.motion is not None:
        return problem
    sigma = initial_noise(data).sigma
    noise = estimate_motion_noise(problem.model, data, problem.start, limits, problem.active, sigma)
    return problem._replace(motion=noise if noise.used.any() else None)


def with_noise(problem: Problem, theta: np.ndarray, noise: Noise) -> Problem:
    """Return the problem with this noise, and gains along the path of the car `theta`.

    Where no sideslip is measured, pieces begin with the likeliest one of that car.
    """
    model, vector = problem.model, noise.as_vector()
    data = with_likeliest_start(model, problem.data, theta, vector)
    gains = observer_gains(model, data, theta, vector)
    return problem._replace(data=data, noise=noise, gains=gains)


def linearise(problem: Problem, fit: Fit) -> Linearisation:
    """Return whitened innovations and their derivatives at `fit`, and those of pose and accelerations that count."""
    linearisation = differentiate(problem.model, problem.data, fit.theta, problem.gains, problem.active, fit.path)
    if (
        problem.data.skip and (lost := lost_samples(np.asarray(linearisation.J))).any()
    ):  # a measured sideslip holds the observer
        linearisation = linearisation._replace(
            J=np.where(lost[..., None, None], 0.0, np.asarray(linearisation.J)), lost=lost
        )
    if problem.motion is None:
        return linearisation
    J = whitened_motion_derivatives(problem.model, problem.data, fit.theta, problem.motion, problem.active)
    return linearisation._replace(e=fit.e, J=np.concatenate([np.asarray(linearisation.J), J], axis=2))


def lost_samples(J: np.ndarray) -> np.ndarray:
    """Return the samples (P, T) from which on the observer has lost the car, by the derivatives `J` (P, T, c, K).

    Without a sideslip sensor its car may spin where the real one does not. Its gains, which belong to another path,
    then make derivatives grow from sample to sample without bound; a single one would outweigh the whole log.
    """
    size = np.nan_to_num(np.abs(J).max(axis=(2, 3)), nan=np.inf)
    usual = np.median(size.max(axis=1))
    return np.maximum.accumulate(size > np.clip(LOST * usual, *LOST_LIMITS), axis=1)


def time_lost(problem: Problem, linearisation: Linearisation) -> float:
    """Return the time in which the observer loses the car [s]; raises `BadInput` where it is most of the time."""
    if linearisation.lost is None:
        return 0.0
    there = samples_in_run(np.asarray(problem.data.padded.valid))
    if (share := np.sum(linearisation.lost & there) / np.sum(there)) > MOST_LOST:
        raise BadInput(f"log: the observer loses the car in {100 * share:.0f} % of the time; check units, signs and "
                       "the vehicle, and give it the steering delay that `driftjax inspect` prints.")  # fmt: skip
    return float(np.sum(linearisation.lost & there) * problem.data.dt)


def evaluate_fit(problem: Problem, theta: np.ndarray) -> Fit:
    """Evaluate the cost of the hypothesis `theta` (K,), infinite where the observer diverges."""
    return evaluate_fits(problem, [theta])[0]


def evaluate_fits(problem: Problem, thetas: Sequence[np.ndarray]) -> list[Fit]:
    """Evaluate the costs of hypotheses in batches, infinite where the observer diverges.

    A delay assigns the first measurements to times before the run; these cost what noise costs, since leaving them out
    would reward the delay.
    """
    model, data, num, fits = problem.model, problem.data, len(problem.data.run), []
    for k in range(0, len(thetas), together := max(MOST_ROWS // num, 1)):
        some = np.asarray(thetas[k : k + together])
        row = np.arange(len(some) * num)
        path = run_observers(model, data, some[row // num], row % num, problem.gains)
        motions = [None] * len(some)
        if problem.motion is not None:
            motions = whitened_residuals(model, data, some, problem.motion)
        for theta, its, motion in zip(some, row.reshape(-1, num), motions, strict=True):
            fits.append(_fit_of(problem, theta, take(path, its), motion))
    return fits


def _fit_of(problem: Problem, theta: np.ndarray, path: Path, motion: tuple[np.ndarray, int] | None) -> Fit:
    """Return the fit of the hypothesis `theta` (K,), whose observer followed `path`, with its residual `motion`."""
    e = np.asarray(whiten(problem.gains, path.e))
    used = path.valid * np.any(problem.gains.whitening, axis=-1)
    cost = float(np.sum(e**2)) + float(np.sum(problem.data.padded.valid * problem.data.informative - used))
    if motion is not None:
        further, missing = motion
        e, cost = np.concatenate([e, further], axis=2), cost + float(np.sum(further**2)) + missing
    moved = theta - problem.start
    cost += float(moved @ problem.prior @ moved)
    return Fit(theta, cost if np.isfinite(cost) else np.inf, e, path)


def at_bound(problem: Problem, theta: np.ndarray) -> np.ndarray:
    """Return whether each parameter (K,) is at an active bound of its own."""
    return (theta == problem.lower) & (problem.lower != 0) | (theta == problem.upper)


def information(J: ArrayLike) -> np.ndarray:
    """Return the information matrix (K, K) of derivatives (P, T, c, K)."""
    J = np.asarray(J)
    return np.einsum("ptij,ptik->jk", J, J, optimize=True)


def information_and_score(linearisation: Linearisation) -> tuple[np.ndarray, np.ndarray]:
    """Return the information matrix (K, K) and the score (K,)."""
    return information(linearisation.J), np.einsum(
        "ptij,pti->j", np.asarray(linearisation.J), np.asarray(linearisation.e), optimize=True
    )
