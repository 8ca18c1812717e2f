"""A search that begins far from the truth: with an observer that follows whatever acts on the nominal car."""

import numpy as np

from driftjax.core import BadInput
from driftjax.diagnosis.fit import Fit, Problem, priced, settle, tuned
from driftjax.diagnosis.select import MOST, Selection, prune, search

LOST = 200.0  # cost per measurement from which the observer of the nominal car has lost it: 14 standard deviations
FAR = 1.5  # and from which a fit is not one: noise is what no effects explain, so a right one ends near 1


def nominal(task: Problem) -> Fit:
    """The car before anything is named."""
    return priced(task, task.start)


def misfit(task: Problem, fit: Fit) -> float:
    """Cost per measurement: 1 for a right model."""
    return fit.cost / float(np.sum(np.asarray(task.data.track.seen)))


def kept(fit: Fit) -> Fit:
    """`fit`, if its observer has not lost the car."""
    if not np.isfinite(fit.cost):
        raise BadInput("log: the observer of the nominal car loses these data; check units, signs and the vehicle.")
    return fit


def approach(task: Problem, seed: int = 0, most: int = MOST) -> tuple[Problem, Selection]:
    """What is found in `task`, with the problem that it was found in: the same one but where that leads nowhere.

    Strong effects in data of little disturbance throw the observer of the nominal car off, whose noise is what remains
    beside all effects; then the search goes round about.
    """
    start = nominal(task)
    close = search(task, start, seed, most=most) if misfit(task, start) < LOST else None
    if close and misfit(task, close.fit) < FAR:
        return task, close
    anew, found = round_about(task, seed, most)
    if close and misfit(task, close.fit) <= misfit(anew, found.fit):
        return task, close
    return anew, found


def loosened(task: Problem) -> Problem:
    """The problem with the noise that the nominal car needs for itself: nothing is explained away."""
    return tuned(task, task.start, np.zeros_like(task.asked))


def round_about(task: Problem, seed: int = 0, most: int = MOST) -> tuple[Problem, Selection]:
    """What is found with the disturbances that the nominal car needs for itself, weighed once more with noise and
    observer of the car found."""
    loose = loosened(task)
    start = kept(nominal(loose))
    rough = search(loose, start, seed, most=most)
    anew = tuned(task, rough.fit.theta, task.asked)
    fit = settle(anew, priced(anew, rough.fit.theta), anew.columns(rough.members))[0]
    members, fit = prune(anew, rough.members, kept(fit))
    found = search(anew, fit, seed, members, most)
    return anew, found._replace(base=loose, nominal=start, first=rough.first)
