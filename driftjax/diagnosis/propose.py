"""Propose the next manoeuvre: the one that best separates rival explanations.

The paper explores cornering speeds by the variance of its model; here every manoeuvre of the library is driven on the
extended car, and the one whose data would tell the rivals apart best is proposed (Hunter and Reiner 1965; Box and
Hill 1967): the information that it adds says by how much the rivals' penalised costs would differ.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.evidence import Cause
from driftjax.diagnosis.fit import Problem, evaluate_fit, information, linearise, measured_pieces, with_noise
from driftjax.diagnosis.rivals import fit_dispersion
from driftjax.diagnosis.score import partial_out
from driftjax.diagnosis.select import Selection
from driftjax.diagnosis.verdict import Judgement, Verdict, detectable_share
from driftjax.logs import Log, Run
from driftjax.manoeuvres.campaign import SLOWEST_RATE, Campaign, record_runs
from driftjax.manoeuvres.library import MANOEUVRES, NoDrift
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import EFFECTS

DURATION = 10.0  # of a proposed run [s]


def drivable_runs(vehicle: VehicleConfig, theta: np.ndarray, rate: float, seed: int) -> tuple[Run, ...]:
    """Record every manoeuvre of the library that the car can drive: no drift without a drift equilibrium.

    Its driver is as fast as a `Campaign` asks for, also where the log has a lower `rate` [Hz].
    """
    runs: list[Run] = []
    driven = rate * math.ceil(SLOWEST_RATE / rate)
    for name in MANOEUVRES:
        try:
            runs += record_runs(vehicle, theta, Campaign((name,), DURATION, driven, seed=seed))[0]
        except NoDrift:
            continue
    return Log(tuple(runs)).thin(rate).runs if runs else ()


class Proposal(NamedTuple):
    """A proposed manoeuvre and its expected benefit."""

    manoeuvre: str
    duration: float  # [s]
    now: float  # probability of the least sure cause, or share of the effects that would show
    after: float  # the same, as expected with the run added
    others: dict[str, float]  # the same of all manoeuvres that the car survives
    sentence: str


def propose_manoeuvre(
    vehicle: VehicleConfig, problem: Problem, selection: Selection, named: list[Cause], judgement: Judgement, seed: int
) -> Proposal | None:
    """Propose the manoeuvre that should resolve a SET or insufficient data; None for other verdicts.

    None too where the car survives no manoeuvre of the library.
    """
    if judgement.verdict not in (Verdict.SET, Verdict.DATA_INSUFFICIENT):
        return None
    runs = drivable_runs(vehicle, in_full_catalogue(problem, selection.fit.theta), 1 / problem.data.dt, seed)
    if not runs:
        return None
    value = lambda H: (
        _least_sure(problem, selection, named, H) if named else detectable_share(problem, selection.scores.H + H)
    )
    added = added_information(vehicle, problem, selection, runs)
    zero = np.zeros_like(selection.scores.H)
    now, each = value(zero), {run.name.rsplit("-", 1)[0]: value(H) for run, H in zip(runs, added, strict=True)}
    best = max(each, key=lambda name: each[name])
    what = "the least sure name's probability" if named else "the share of effects that would show"
    same = ", with the same sensors" if problem.data.skip or not problem.data.force_known else ""
    text = f"Drive '{best}' for {DURATION:g} s next{same}: it should raise {what} from {now:.2f} to {each[best]:.2f}."
    return Proposal(best, DURATION, now, each[best], each, text)


def in_full_catalogue(problem: Problem, theta: np.ndarray) -> np.ndarray:
    """Return `theta` of the problem's effects as parameters of the whole catalogue, others neutral."""
    own = {effect.name: theta[problem.columns((i,))] for i, effect in enumerate(problem.effects)}
    return np.concatenate([own.get(name, np.zeros(len(e.parameters))) for name, e in EFFECTS.items()])


def added_information(
    vehicle: VehicleConfig, problem: Problem, selection: Selection, runs: tuple[Run, ...]
) -> list[np.ndarray]:
    """Return the information (K, K) that each of `runs` would add, linearised at the fit.

    Channels that the log of the `problem` lacks are not measured in them either.
    """
    data = measured_pieces(vehicle, tuple(_as_logged(run, problem) for run in runs))
    theta, motion = selection.fit.theta, problem.motion
    if motion is not None:  # a channel of which some windows count counts in all of theirs
        motion = motion._replace(used=motion.used.any(axis=(0, 1)))
    driven = with_noise(problem._replace(data=data, motion=motion), theta, problem.noise)
    J = np.asarray(linearise(driven, evaluate_fit(driven, theta)).J)
    return [information(J[data.run == i]) for i in range(len(runs))]


def _as_logged(run: Run, problem: Problem) -> Run:
    """Return the run with the channels that the log of the `problem` has."""
    missing, log = np.full(len(run.t), np.nan), problem.data
    extra = {name: values for name, values in run.extra.items() if name in problem.extra_columns}
    beta, Fxr = (missing if log.skip else run.beta), (run.Fxr if log.force_known else missing)
    return replace(run, beta=beta, Fxr=Fxr, extra=extra)


def _least_sure(problem: Problem, selection: Selection, named: list[Cause], added: np.ndarray) -> float:
    """Return the expected probability of the least certain cause with the information `added` (K, K)."""
    least, excess = 1.0, fit_dispersion(problem, selection)
    for cause in named:
        others = problem.columns(tuple(i for i in selection.selected if i != cause.effect))
        compare_hidden = 0.0
        for rival, probability in cause.rivals.items():
            more = _apart(problem, selection, cause.effect, rival, others, selection.scores.H + added)
            more -= _apart(problem, selection, cause.effect, rival, others, selection.scores.H)
            compare_hidden += probability / max(cause.probability, 1e-12) * np.exp(-0.5 * more / excess)
        least = min(least, 1 / (1 + compare_hidden))
    return least


def _apart(problem: Problem, selection: Selection, one: int, rival: int, others: np.ndarray, H: np.ndarray) -> float:
    """Return the cost that remains of the effect `one` when the `rival` replaces it, refitted with all `others`."""
    columns, fitted = problem.columns((one,)), np.concatenate([others, problem.columns((rival,))])
    P = partial_out(H, fitted)[:, columns]
    theta = selection.fit.theta[columns]
    return float(theta @ P.T @ H @ P @ theta)
