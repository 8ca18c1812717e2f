"""The closed set of verdicts, and the sentence that a person would say."""

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.evidence import Cause
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.select import Selection
from driftjax.diagnosis.unknown import Term, Unexplained

SURE = 0.95  # probability from which one name stands alone
SHORTEST = 5.0  # data below which nothing is said [s]
DETECTABLE = 4.0  # typical size over its standard deviation from which the data could show an effect
BLIND = 0.5  # share of effects that must be detectable before finding nothing means anything
VARIES = 0.001  # probability below which an effect that differs between runs is no cause but stands for one


class Verdict(StrEnum):
    """What a diagnosis may say."""

    NOTHING = "NOTHING"
    NAMED = "NAMED"
    SET = "SET"
    UNKNOWN = "UNKNOWN"
    DATA_INSUFFICIENT = "DATA_INSUFFICIENT"


class Judgement(NamedTuple):
    """Verdict with its reason."""

    verdict: Verdict
    sentence: str


def shown(task: Problem, H: np.ndarray) -> float:
    """Share of the one-parameter effects in question whose typical size data with the information H (K, K) show."""
    single = np.bincount(task.owner)[task.owner] == 1
    return float(np.mean(np.sqrt(np.diag(H)[single & task.asked]) > DETECTABLE))


def judge(task: Problem, found: Selection, named: list[Cause], left: Unexplained, duration: float) -> Judgement:
    """The verdict on a search and what to say of it."""
    varying = [task.effects[cause.effect].name for cause in named if cause.invariance < VARIES]
    if left.found or left.simpler or varying:
        return Judgement(Verdict.UNKNOWN, _unknown(task, named, left, varying))
    if not named:
        share = shown(task, found.scores.H)
        if share < BLIND:
            text = f"These {duration:.0f} s hardly excite the car: only {100 * share:.0f} % of the effects would show."
            return Judgement(Verdict.DATA_INSUFFICIENT, text + " Record drifts and cornering with changing drive.")
        return Judgement(Verdict.NOTHING, f"Nothing is missing that {duration:.0f} s of these data could show.")
    verdict = Verdict.NAMED if all(cause.probability >= SURE for cause in named) else Verdict.SET
    return Judgement(verdict, " ".join(phrase(task, cause) for cause in named))


def phrase(task: Problem, cause: Cause) -> str:
    """One cause in words: what, how much, how sure, and what it may be instead."""
    effect = task.effects[cause.effect]
    scale = np.asarray(task.model.scale)[task.columns((cause.effect,))]
    rows = zip(effect.parameters, cause.theta, cause.half_width, scale, strict=True)
    values = [f"{p.name} = {x * s:.3g} ± {w * s:.2g}{p.suffix}" for p, x, w, s in rows]
    text = f"{effect.sentence[0].upper()}{effect.sentence[1:]} ({effect.name}: {', '.join(values)}; "
    text += f"P = {cause.probability:.2f})."
    if cause.probability < SURE and cause.rivals:
        others = ", ".join(f"{task.effects[i].name} ({p:.2f})" for i, p in list(cause.rivals.items())[:3])
        text += f" These data do not rule out {others}."
    return text


def _unknown(task: Problem, named: list[Cause], left: Unexplained, varying: list[str]) -> str:
    names = ", ".join(task.effects[cause.effect].name for cause in named)
    if left.found:
        text = f"Something is missing that no effect of the catalogue explains (p = {left.p_value:.3f})"
        text += f", beside {names}" if named else ""
        return f"{text}; it goes most with {' and '.join(list(left.drivers)[:2])}, such as {_words(left.term)}."
    if left.simpler:
        text = f"Something is missing that no effect of the catalogue explains: {names} together explain no more than"
        return f"{text} {_words(left.simpler)}; it goes most with {' and '.join(list(left.at_first)[:2])}."
    return f"Something is missing that {', '.join(varying)} only stands for: its size differs from run to run."


def _words(term: Term) -> str:
    """A generic term in words."""
    where = f"in the rate of {term.channel}" if term.where == "rate" else f"in what is measured as {term.channel}"
    return f"{term.value:.2g} ± {term.half_width:.1g} {term.unit} times {term.function} {where}"
