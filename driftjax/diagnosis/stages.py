"""Fit effects stage by stage: gentle stretches of a log are used before harder ones.

A stage frees the effects of its own kind and those of earlier stages, and counts only innovations of its own
stretches. Effects of later stages are not estimated, but their uncertainty is part of the covariance of the estimate
(consider filter; Schmidt 1966). Estimate and covariance are the next stage's prior, so that harder stretches move an
earlier estimate according to the precision of both.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.fit import Fit, Problem, evaluate_fit, information, with_estimated_noise
from driftjax.diagnosis.identifiability import DEAD
from driftjax.diagnosis.motion import window_ends
from driftjax.diagnosis.multistart import require_finite_cost
from driftjax.diagnosis.noise import PRIOR
from driftjax.diagnosis.refine import refit_to_convergence
from driftjax.diagnosis.runs import Linearisation, take
from driftjax.diagnosis.score import overdispersion, sums_by_block
from driftjax.diagnosis.stretches import Stretch, find_stretches

LEAST = 10.0  # time that all stretches of a stage last together, or else it is left out [sqrt(L/g)]
PASSES = 3  # through all stages at most, once the noise of the fitted car is known
SETTLED = 0.2  # largest change of a parameter in a pass, in its standard deviations, from which another is worthwhile


class CalibrationStage(NamedTuple):
    """One stage of a calibration."""

    stretches: tuple[Stretch, ...]  # whose innovations count
    effects: frozenset[str]  # freed from here on

    @property
    def label(self) -> str:
        """Return the stretches as printed."""
        return " and ".join(kind.label for kind in self.stretches)


STAGES = (
    CalibrationStage(
        (Stretch.COASTING, Stretch.STRAIGHT),
        frozenset({"drive_gain", "drive_lag", "power_limit", "engine_drag", "rolling_resistance", "aero_drag", "mass",
                   "speed_scale", "gyro_bias", "sideslip_bias", "road_grade"}),
    ),
    CalibrationStage(
        (Stretch.CORNERING,),
        frozenset({"steer_offset", "steer_gain", "steer_lag", "steer_delay", "steer_backlash", "steer_compliance",
                   "stiffness_front", "stiffness_rear", "relaxation_length", "roll_steer", "roll_lag", "yaw_inertia",
                   "cog_shift", "yaw_moment", "torque_vectoring", "gyro_scale", "imu_lever_arm", "channel_delay",
                   "road_bank", "side_wind"}),
    ),
    CalibrationStage(
        (Stretch.LIMIT,),
        frozenset({"friction", "friction_front", "friction_rear", "tyre_shape", "sliding_friction", "friction_fade",
                   "tyre_curve_front", "tyre_curve_rear",
                   "friction_patch", "traction_limit", "combined_slip", "load_sensitivity", "load_transfer_long",
                   "load_transfer_lat", "track_width", "downforce", "differential_moment", "drive_split", "brake_split",
                   "wheel_spin"}),
    ),
)  # fmt: skip


class StagedFit(NamedTuple):
    """Result of all stages."""

    theta: np.ndarray  # (K,) in typical sizes
    stretch: np.ndarray  # (P, T) kind of stretch of each sample
    precision: np.ndarray  # (K, K) that the data give the parameters, and a tenth of the prior
    prior: np.ndarray  # (K,) precision of the prior, as it counted
    dispersion: np.ndarray  # (4,) of scores over their information, by kind of stretch; infinite where none counted
    moved: np.ndarray  # (K,) change by later stages, in standard deviations of the estimate of the own stage

    def weigh(self, linearisation: Linearisation) -> Linearisation:
        """Return innovations and derivatives weighted as in the fit: by the root of their dispersion."""
        weight = np.append(1 / np.sqrt(self.dispersion), 0.0)[self.stretch]
        return linearisation._replace(
            e=linearisation.e * weight[..., None], J=np.asarray(linearisation.J) * weight[..., None, None]
        )


def fit_staged(
    loose: Problem, selected: tuple[int, ...], near: Problem | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> tuple[Problem, Fit, StagedFit]:  # fmt: skip
    """Fit the effects `selected` by stages; return the problem with noise re-estimated at the fit, and the fit.

    `loose` has the noise of the nominal car, as for a fit at once. `near` is the problem of all passes but the first
    where its noise is known. `report` is called at every pass and stage.
    """
    words = lambda number: lambda stage: report(f"pass {number}, {stage.label}")
    stretch, columns = find_stretches(loose), loose.columns(selected)
    last = run_stages(loose, stretch, columns, loose.start, np.ones(len(Stretch)), words(1))
    if near is None:
        near = with_estimated_noise(loose, last.theta, np.isin(np.arange(len(loose.owner)), columns))
    for number in range(2, PASSES + 2):
        before, last = last, run_stages(near, stretch, columns, last.theta, last.dispersion, words(number))
        spread = np.sqrt(np.diag(np.linalg.inv(last.precision)))
        if np.abs((last.theta - before.theta) / spread).max() < SETTLED:
            break
    return near, require_finite_cost(evaluate_fit(near, last.theta)), last


def run_stages(
    problem: Problem,
    stretch: np.ndarray,
    columns: np.ndarray,
    theta: np.ndarray,
    expected: np.ndarray,
    begin: Callable[[CalibrationStage], None] = lambda stage: None,
) -> StagedFit:
    """Run all stages once for the parameters `columns`, from `theta` (K,); later stages' parameters keep its values.

    Scores are `expected` to vary by so many times their information, by kind of stretch (4,): innovations that depend
    on each other, or that no car explains, count less than those of other stages. `begin` is called at every stage.
    """
    K, names = len(problem.owner), np.array([problem.effects[i].name for i in problem.owner])
    chosen, freed, dispersion = np.isin(np.arange(K), columns), np.zeros(K, bool), np.full(len(Stretch), np.inf)
    own, spread, known, own_information = theta.copy(), np.ones(K), np.zeros((K, K)), np.zeros((K, K))
    prior, weight = np.diag(problem.prior).copy(), np.diag(problem.prior).copy()
    for stage in STAGES:
        freed |= chosen & np.isin(names, list(stage.effects))
        active = np.isin(stretch, stage.stretches)
        if not freed.any() or np.sum(active) < least_samples(problem):
            continue
        begin(stage)
        excess = expected[stage.stretches[0]]
        prior[freed] /= excess  # of those estimated first: it counts as in a fit at once
        first = freed & (prior > 0)
        weight[first] = prior[first]
        precision = known + np.diag(prior)
        centre = np.linalg.solve(precision, known @ theta + prior * problem.start)
        part = restrict_to_samples(problem, active)._replace(start=centre, precision=excess * precision)
        fit, linearisation = refit_to_convergence(
            part, require_finite_cost(evaluate_fit(part, theta)), np.flatnonzero(freed)
        )
        theta, H = fit.theta, information(linearisation.J) / excess
        known, own_information = (
            marginal_precision(precision + H, freed),
            marginal_precision(own_information + np.diag(DEAD * prior) + H, freed),
        )
        prior[freed] = 0.0  # contained in what is known
        own[first], spread[first] = theta[first], np.sqrt(np.diag(np.linalg.inv(known + np.diag(prior))))[first]
        dispersion[list(stage.stretches)] = stage_dispersion(part, linearisation, np.flatnonzero(freed))
    precision = own_information + np.diag(DEAD * prior)
    return StagedFit(theta, stretch, precision, weight, dispersion, (theta - own) / spread)


def least_samples(problem: Problem) -> float:
    """Return the least number of samples for a kind of stretch to be used."""
    return LEAST * float(problem.model.base.unit_time) / problem.data.dt


def stage_dispersion(part: Problem, linearisation: Linearisation, columns: np.ndarray) -> float:
    """Return the `overdispersion` of the scores of the parameters `columns`, over blocks in which any is not zero."""
    H, blocks = sums_by_block(part, linearisation.e, linearisation.J)
    some = blocks[:, columns].any(axis=1)
    return overdispersion(H + np.eye(len(H)) / PRIOR**2, blocks[some], columns)


def restrict_to_samples(problem: Problem, active: np.ndarray) -> Problem:
    """Restrict the cost to the innovations at the `active` samples (P, T).

    The observer is the same: it uses all measurements as before. Pieces without such samples are left out.
    """
    keep = np.flatnonzero(active.any(axis=1))
    active, gains, motion = active[keep], take(problem.gains, keep), problem.motion
    gains = gains._replace(whitening=gains.whitening * active[..., None, None])
    if motion is not None:
        used = motion.used[keep] & active[:, window_ends(problem.model, problem.data)][..., None]
        motion = motion._replace(used=used) if used.any() else None
    return problem._replace(data=problem.data.subset(keep), gains=gains, motion=motion)


def marginal_precision(precision: np.ndarray, freed: np.ndarray) -> np.ndarray:
    """Return the precision (K, K) of all parameters after a stage that estimated those `freed` (K,).

    `precision` (K, K) is the sum of the prior one and the information of the stage. The freed parameters are
    conditioned on the others; about the others the stage has no information.
    """
    row = precision[freed]
    return row.T @ np.linalg.solve(row[:, freed], row)
