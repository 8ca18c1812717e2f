"""Verdicts of a diagnosis, and the sentences that state them."""

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.curves import describe_curve
from driftjax.diagnosis.evidence import SURE_PROBABILITY, Cause
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import Share
from driftjax.diagnosis.prediction_fit import PredictionFit
from driftjax.diagnosis.select import Selection
from driftjax.diagnosis.unexplained_errors import Term, Unexplained
from driftjax.vehicle.effect.families import FAMILY_OF

MIN_DURATION = 5.0  # data below which nothing is said [s]
DETECTABLE = 4.0  # typical size over its standard deviation from which the data could show an effect
MIN_DETECTABLE_SHARE = 0.5  # share of effects that must be detectable before finding nothing means anything
MAY_BE_THE_FORCE = "What is named here may all be errors of the drive force, which was inferred beside the sideslip."
MAY_BE_ONE = (
    "Beside a drive force that was inferred with the sideslip, what is named here may be one cause that is missing."
)
MOST = 0.5  # share of the excess error that what is named must explain beyond doubt


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


class Explained(NamedTuple):
    """How much of the excess open-loop error the extended car explains, at the decisive horizon."""

    share: float  # NaN where it is in doubt that anything is to be explained
    ci95: tuple[float, float]
    remaining: float  # share of its own squared error that a right model would not make
    remaining_ci95: tuple[float, float]
    horizon: float  # [s]
    held_out: bool  # whether measured on runs without which the effects were named

    def unexplained_exceeds(self, tolerated: float) -> bool:
        """Return whether more than the share `tolerated` is surely left, or it is not sure that most is explained.

        In either case what is left must be that share of the model's own error too: a small excess is no reason to
        doubt a model, however significant. Equivalence is judged by size (Schuirmann 1987; ISO 19364).
        """
        enough = self.ci95[1] >= 1 - tolerated and self.ci95[0] >= MOST  # false where the share is NaN
        return not enough and self.remaining_ci95[0] > tolerated


def explained_by(shares: dict[str, Share], named: bool, horizon: float, held_out: bool) -> Explained | None:
    """Return the error that what is `named` explains: nothing without a name; None where no run is long enough.

    A part of the runs may name what all of them do not. What that explains is no answer then.
    """
    if "extended" not in shares:
        return None
    one = shares["extended" if named else "nominal"]
    return Explained(one.value, one.ci95, one.remaining, one.remaining_ci95, horizon, held_out)


def decide_verdict(
    problem: Problem, selection: Selection, named: list[Cause], remaining: Unexplained, duration: float,
    explained: Explained | None, tolerated: float, unconfirmed: tuple[str, ...] = (),
) -> Judgement:  # fmt: skip
    """Decide the verdict on a search by the size of the unexplained error, and state the reason.

    UNKNOWN says that more than the share `tolerated` of the excess error is left, or that what remains is significant
    and no run is long enough to measure its size. Names are certain only where no generic term that remains explains
    more than the share `tolerated` of the misfit that effects and term explain together; else they may stand for a
    cause that the catalogue lacks. UNKNOWN is also said where all names may stand for errors of an inferred drive
    force: none is firm, or one generic term explains as much. `unconfirmed` are the effects that were left out again.
    """
    large = (
        explained.unexplained_exceeds(tolerated)
        if explained
        else remaining.significant or remaining.simpler is not None
    )
    if large and (remaining.significant or remaining.simpler or named):
        return Judgement(Verdict.UNKNOWN, " ".join([_unknown(problem, named, remaining), *_size(explained, remaining)]))
    if not named:
        return _nothing_named(problem, selection, remaining, duration, _left_out(problem, unconfirmed))
    varying = [problem.effects[cause.effect].name for cause in named if cause.varies]
    claimed = [cause for cause in named if not cause.exploratory]
    sure = lambda cause: cause.probability >= SURE_PROBABILITY and not cause.stands_in
    doubt = _doubt(remaining, tolerated)
    words = [describe_cause(problem, cause) for cause in named]
    if varying:
        words.append(f"The size of {', '.join(varying)} differs from run to run: it stands for something else.")
    words += [one for one in (doubt, _left_out(problem, unconfirmed)) if one]
    if problem.data.force_inferred and (remaining.simpler or not claimed):
        words.insert(0, MAY_BE_ONE if claimed else MAY_BE_THE_FORCE)
        return Judgement(Verdict.UNKNOWN, " ".join([*words, *_size(explained, remaining)]))
    verdict = Verdict.NAMED if all(map(sure, claimed or named)) and not doubt else Verdict.SET
    return Judgement(verdict, " ".join([*words, *_size(explained, remaining)]))


def without_lost_time(judgement: Judgement, lost_s: float, duration: float, tolerated: float) -> Judgement:
    """Return the judgement; UNKNOWN where the observer loses the car for more than the share `tolerated` of the time.

    What does not count is not explained, and names what keeps the observer on the rest.
    """
    if lost_s <= tolerated * duration or judgement.verdict is Verdict.DATA_INSUFFICIENT:
        return judgement
    text = f"The observer loses the car for {100 * lost_s / duration:.0f} % of the time, which nothing here explains."
    return Judgement(Verdict.UNKNOWN, f"{text} {judgement.sentence}")


def _nothing_named(
    problem: Problem, selection: Selection, remaining: Unexplained, duration: float, left_out: str
) -> Judgement:
    share = detectable_share(problem, selection.scores.H)
    if share < MIN_DETECTABLE_SHARE:
        text = f"These {duration:.0f} s hardly excite the car: only {100 * share:.0f} % of the effects would show."
        return Judgement(Verdict.DATA_INSUFFICIENT, text + " Record drifts and cornering with changing drive.")
    text = f"Nothing is missing that {duration:.0f} s of these data could show"
    if remaining.significant:
        text += f" and that matters: what remains (p = {remaining.p_value:.3f}) is too small to change predictions"
    return Judgement(Verdict.NOTHING, f"{text}. {left_out}".strip())


def _left_out(problem: Problem, unconfirmed: tuple[str, ...]) -> str:
    """Return why the effects `unconfirmed` are not named; empty without any."""
    if not unconfirmed:
        return ""
    text = f"Left out is {', '.join(unconfirmed)}: named from"
    if problem.data.force_inferred:
        return f"{text} an inferred drive force, whose errors it may stand for, and no prediction suffers from it."
    return f"{text} all runs together, but not likewise without those held out, and no prediction suffers from it."


def _doubt(remaining: Unexplained, tolerated: float) -> str:
    """Return why the named effects may stand for a cause that the catalogue lacks; empty where nothing says so."""
    if remaining.simpler:
        return f"Together they explain no more than {_words(remaining.simpler)} would."
    if not (remaining.significant and remaining.share > tolerated):
        return ""
    share = f"explains {100 * remaining.share:.0f} % of the misfit that both explain"
    return f"The catalogue may lack the cause: beside these names {_words(remaining.term)} {share}."


def describe_cause(problem: Problem, cause: Cause) -> str:
    """Describe one cause in words: effect, size, probability and rivals."""
    effect = problem.effects[cause.effect]
    scale = np.asarray(problem.model.scale)[problem.columns((cause.effect,))]
    rows = zip(effect.parameters, cause.theta, cause.half_width, scale, cause.at_bound, strict=True)
    values = [
        f"{p.name} at its bound of {x * s:.3g}{p.suffix}" if end else f"{p.name} = {x * s:.3g} ± {w * s:.2g}{p.suffix}"
        for p, x, w, s, end in rows
    ]
    text = "Exploratory: " if cause.exploratory else ""
    text += f"{effect.sentence[0].upper()}{effect.sentence[1:]} ({effect.name}: {', '.join(values)}; "
    text += f"P = {cause.probability:.2f})."
    if cause.curve:
        text += f" {describe_curve(cause.curve)}"
    if cause.at_bound.any():
        text += " More than its bound is not plausible: it stands for something else."
    if cause.probability < SURE_PROBABILITY <= cause.family_probability:
        family = FAMILY_OF[effect.name]
        text += f" That it is the {family} is sure (P = {cause.family_probability:.2f}), which member is not."
    if cause.probability < SURE_PROBABILITY and cause.rivals:
        others = ", ".join(f"{problem.effects[i].name} ({p:.2f})" for i, p in list(cause.rivals.items())[:3])
        text += f" These data do not rule out {others}."
    return text


def describe_answer(answer: str, problem: Problem, retuned: PredictionFit | None, shares: dict[str, Share]) -> str:
    """Describe the car that predicts held-out runs best, where it is not the one with the named effects.

    Effects of the `retuned` car have one parameter each; `shares` say how much of the error a car explains.
    """
    better = "predicts better than the one with the named effects"
    if answer == "nominal":
        return f"On held-out runs the nominal car {better}: it stays the answer. "
    if retuned is None:
        return ""
    scale, share, sizes = np.asarray(problem.model.scale), shares.get("retuned"), []
    for k, half_width in zip(retuned.columns, retuned.spread.half_width, strict=True):
        size, width, before = (scale[k] * value for value in (retuned.theta[k], half_width, problem.start[k]))
        name, words = problem.effects[problem.owner[k]].name, f", before {before:+.2g}" if before else ""
        sizes.append(f"{name} {size:+.2g} ± {width:.1g}{words}")
    explains = ""
    if share and np.isfinite(share.value):
        explains = f", which explains {_percent(share.value, share.ci95)} of the excess error"
    text = (
        f"On held-out runs the car with friction and stiffness re-tuned ({'; '.join(sizes)}) {better}: it is the answer"
    )
    return f"{text}{explains}. "


def describe_fit(by_predictions: bool, sizes: PredictionFit | None, horizon: float) -> str:
    """Describe what effects and sizes are named from, where that is not the likelihood of single steps."""
    if by_predictions:
        text = (
            f"Single steps mislead here: the effects are those that an observer with a memory of {horizon:.2g} s names"
        )
        return f"{text}, and their sizes predict best." if sizes else f"{text}."
    if sizes is None:
        return ""
    return f"The named effects leave errors, so their sizes are those that predict best up to {horizon:.2g} s ahead."


def _percent(share: float, ci95: tuple[float, float]) -> str:
    return f"{100 * share:.0f} % [{100 * ci95[0]:.0f}, {100 * ci95[1]:.0f}]"


def _size(explained: Explained | None, remaining: Unexplained) -> list[str]:
    """Return, in words, what the named effects explain, and which variable the rest depends on."""
    rest = f"rest goes most with {' and '.join(list(remaining.variables)[:2])}." if remaining.significant else ""
    if explained is None:
        return [f"The {rest}"] if rest else []
    if not np.isfinite(explained.share):
        doubt = f"Whether the nominal car errs by more than noise {explained.horizon:.2g} s ahead is in doubt"
        return [f"{doubt}; the {rest}" if rest else f"{doubt}."]
    where = "on held-out runs" if explained.held_out else "on these runs"
    share = _percent(explained.share, explained.ci95)
    text = f"Explained: {share} of the excess error {explained.horizon:.2g} s ahead {where}"
    return [f"{text}; the {rest}" if rest else f"{text}."]


def _unknown(problem: Problem, named: list[Cause], remaining: Unexplained) -> str:
    names = ", ".join(problem.effects[cause.effect].name for cause in named)
    if remaining.significant:
        text = f"Something is missing that no effect of the catalogue explains (p = {remaining.p_value:.3f})"
        text += f", beside {names}" if named else ""
        first = " and ".join(list(remaining.variables)[:2])
        return f"{text}; it goes most with {first}, such as {_words(remaining.term)}."
    if remaining.simpler:
        text = f"Something is missing that no effect of the catalogue explains: {names} together explain no more than"
        first = " and ".join(list(remaining.nominal_variables)[:2])
        return f"{text} {_words(remaining.simpler)}; it goes most with {first}."
    return f"Something is missing beside {names} that these data do not tell apart."


def _words(term: Term) -> str:
    """Describe a generic term in words."""
    places = {"rate": "the rate of", "force": "the lateral force", "sensor": "what is measured as"}
    where = f"in {places[term.where]} {term.channel}"
    return f"{term.value:.2g} ± {term.half_width:.1g} {term.unit} times {term.function} {where}"
