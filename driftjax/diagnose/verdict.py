"""The closed set of verdicts, and the sentence that a person would say."""

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from driftjax.diagnose.evidence import Cause
from driftjax.diagnose.fit import Problem, normal
from driftjax.diagnose.select import LEVEL, Selection

SURE = 0.95  # probability from which one name stands alone
SHORTEST = 5.0  # data below which nothing is said [s]
DETECTABLE = 4.0  # typical size over its standard deviation from which the data could show an effect
BLIND = 0.5  # share of effects that must be detectable before finding nothing means anything


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


def detectable(task: Problem, found: Selection) -> float:
    """Share of one-parameter effects whose typical size these data would show."""
    H, _ = normal(found.at)
    each = [task.columns((i,)) for i in range(len(task.effects))]
    single = [int(c[0]) for c in each if len(c) == 1 and task.asked[c[0]]]
    return float(np.mean(np.sqrt(np.diag(H)[single]) > DETECTABLE))


def judge(task: Problem, found: Selection, named: list[Cause], duration: float) -> Judgement:
    """The verdict on a search and what to say of it."""
    left = found.scores.p_value
    if not named and left >= LEVEL:
        share = detectable(task, found)
        if share < BLIND:
            text = f"These {duration:.0f} s hardly excite the car: only {100 * share:.0f} % of the effects would show."
            return Judgement(Verdict.DATA_INSUFFICIENT, text + " Record drifts and cornering with changing drive.")
        return Judgement(Verdict.NOTHING, f"Nothing is missing that {duration:.0f} s of these data could show.")
    if left < LEVEL:
        return Judgement(Verdict.UNKNOWN, _unknown(task, found, named, left))
    parts = [phrase(task, cause) for cause in named]
    verdict = Verdict.NAMED if all(cause.probability >= SURE for cause in named) else Verdict.SET
    return Judgement(verdict, " ".join(parts))


def phrase(task: Problem, cause: Cause) -> str:
    """One cause in words: what, how much, how sure, and what it may be instead."""
    effect = task.effects[cause.effect]
    scale = np.asarray(task.model.scale)[task.columns((cause.effect,))]
    values = [
        f"{p.name} = {x * s:.3g} ± {w * s:.2g} {p.unit}".replace(" 1", "") if p.unit == "1"
        else f"{p.name} = {x * s:.3g} ± {w * s:.2g} {p.unit}"
        for p, x, w, s in zip(effect.parameters, cause.theta, cause.half_width, scale, strict=True)
    ]  # fmt: skip
    text = f"{effect.sentence[0].upper()}{effect.sentence[1:]} ({effect.name}: {', '.join(values)}; "
    text += f"P = {cause.probability:.2f})."
    if cause.probability < SURE and cause.rivals:
        others = ", ".join(f"{task.effects[i].name} ({p:.2f})" for i, p in list(cause.rivals.items())[:3])
        text += f" These data do not rule out {others}."
    return text


def _unknown(task: Problem, found: Selection, named: list[Cause], p_value: float) -> str:
    text = f"Something is missing that no effect of the catalogue explains (p = {p_value:.3f})"
    if named:
        text += ", beside " + ", ".join(task.effects[cause.effect].name for cause in named)
    worst = np.sqrt(np.asarray((found.at.e**2).mean(axis=(0, 1))))
    channel = ("V", "beta", "r")[int(np.argmax(worst))]
    return text + f"; it shows most in {channel}."
