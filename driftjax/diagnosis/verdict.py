"""Verdicts of a diagnosis, and the sentences that state them."""

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.evidence import Cause
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.select import Selection
from driftjax.diagnosis.unknown import Term, Unexplained

SURE_PROBABILITY = 0.95  # probability from which one name stands alone
MIN_DURATION = 5.0  # data below which nothing is said [s]
DETECTABLE = 4.0  # typical size over its standard deviation from which the data could show an effect
MIN_DETECTABLE_SHARE = 0.5  # share of effects that must be detectable before finding nothing means anything
INVARIANCE_LEVEL = 0.001  # probability below which an effect that differs between runs is no cause but stands for one


class Verdict(StrEnum):
    """Possible results of a diagnosis."""

    NOTHING = "NOTHING"
    NAMED = "NAMED"
    SET = "SET"
    UNKNOWN = "UNKNOWN"
    DATA_INSUFFICIENT = "DATA_INSUFFICIENT"


class Judgement(NamedTuple):
    """A verdict with its reason."""

    verdict: Verdict
    sentence: str


def detectable_share(problem: Problem, H: np.ndarray) -> float:
    """Return the share of active one-parameter effects that data of information H (K, K) detect at typical size."""
    single = np.bincount(problem.owner)[problem.owner] == 1
    return float(np.mean(np.sqrt(np.diag(H)[single & problem.active]) > DETECTABLE))


def decide_verdict(
    problem: Problem, selection: Selection, named: list[Cause], remaining: Unexplained, duration: float
) -> Judgement:
    """Decide the verdict on a search and state its reason."""
    varying = [problem.effects[cause.effect].name for cause in named if cause.invariance < INVARIANCE_LEVEL]
    if remaining.significant or remaining.simpler or varying:
        return Judgement(Verdict.UNKNOWN, _unknown(problem, named, remaining, varying))
    if not named:
        share = detectable_share(problem, selection.scores.H)
        if share < MIN_DETECTABLE_SHARE:
            text = f"These {duration:.0f} s hardly excite the car: only {100 * share:.0f} % of the effects would show."
            return Judgement(Verdict.DATA_INSUFFICIENT, text + " Record drifts and cornering with changing drive.")
        return Judgement(Verdict.NOTHING, f"Nothing is missing that {duration:.0f} s of these data could show.")
    verdict = Verdict.NAMED if all(cause.probability >= SURE_PROBABILITY for cause in named) else Verdict.SET
    return Judgement(verdict, " ".join(describe_cause(problem, cause) for cause in named))


def describe_cause(problem: Problem, cause: Cause) -> str:
    """Describe one cause in words: effect, size, probability and rivals."""
    effect = problem.effects[cause.effect]
    scale = np.asarray(problem.model.scale)[problem.columns((cause.effect,))]
    rows = zip(effect.parameters, cause.theta, cause.half_width, scale, strict=True)
    values = [f"{p.name} = {x * s:.3g} ± {w * s:.2g}{p.suffix}" for p, x, w, s in rows]
    text = f"{effect.sentence[0].upper()}{effect.sentence[1:]} ({effect.name}: {', '.join(values)}; "
    text += f"P = {cause.probability:.2f})."
    if cause.probability < SURE_PROBABILITY and cause.rivals:
        others = ", ".join(f"{problem.effects[i].name} ({p:.2f})" for i, p in list(cause.rivals.items())[:3])
        text += f" These data do not rule out {others}."
    return text


def _unknown(problem: Problem, named: list[Cause], remaining: Unexplained, varying: list[str]) -> str:
    names = ", ".join(problem.effects[cause.effect].name for cause in named)
    if remaining.significant:
        text = f"Something is missing that no effect of the catalogue explains (p = {remaining.p_value:.3f})"
        text += f", beside {names}" if named else ""
        return (
            f"{text}; it goes most with {' and '.join(list(remaining.drivers)[:2])}, such as {_words(remaining.term)}."
        )
    if remaining.simpler:
        text = f"Something is missing that no effect of the catalogue explains: {names} together explain no more than"
        drivers = " and ".join(list(remaining.nominal_drivers)[:2])
        return f"{text} {_words(remaining.simpler)}; it goes most with {drivers}."
    return f"Something is missing that {', '.join(varying)} only stands for: its size differs from run to run."


def _words(term: Term) -> str:
    """Describe a generic term in words."""
    where = f"in the rate of {term.channel}" if term.where == "rate" else f"in what is measured as {term.channel}"
    return f"{term.value:.2g} ± {term.half_width:.1g} {term.unit} times {term.function} {where}"
