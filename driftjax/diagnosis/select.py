"""Which effects are named: forward, swap and backward steps between refits of the whole nonlinear model."""

from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.fit import Fit, Problem, around, priced, refine, settle
from driftjax.diagnosis.runs import Followed
from driftjax.diagnosis.score import Scores, scores

LEVEL = 0.05  # family-wise rate at which chance may name an effect
MOST = 4  # effects that a diagnosis names where no other number is asked for
REFITS = 6  # candidates refitted at each step
WORTH = 10.0  # fall of the sum of squares that an effect must earn, beside the test, per parameter
MATERIAL = 0.08  # size below which an effect is left out, in typical sizes


class Selection(NamedTuple):
    """What the search ends with."""

    members: tuple[int, ...]
    fit: Fit
    at: Followed
    scores: Scores  # of what is left out
    base: Problem  # in which the observer of the nominal car follows it: the one searched in, where that does
    nominal: Fit
    first: Scores  # of everything, at the nominal car


def price(task: Problem, fit: Fit, members: tuple[int, ...]) -> float:
    """Cost of a hypothesis with what its parameters must earn."""
    return fit.cost + WORTH * len(task.columns(members))


def material(task: Problem, fit: Fit, effect: int) -> bool:
    """Whether an effect differs from where it starts by what anyone would care for."""
    return bool(np.abs((fit.theta - task.start)[task.columns((effect,))]).max() >= MATERIAL)


def best_of(task: Problem, fit: Fit, members: tuple[int, ...], at: Followed, gain: np.ndarray) -> tuple[tuple, Fit]:
    """`members` with one more, the one whose refit has the least price; themselves where none earns its keep.

    Candidates by the `gain` (E,) they promise at the fit, linearised in `at`; after one step all but the best three
    are given up.
    """
    worth = gain - WORTH * np.array([len(task.columns((i,))) for i in range(len(gain))])
    order = [int(i) for i in np.argsort(-worth)[:REFITS] if gain[i] > 0.2 * gain.max()]
    grown = [(*members, one) for one in order if one not in members]
    trials = [(refine(task, fit, task.columns(new), at, num=1), new) for new in grown]
    trials.sort(key=lambda item: price(task, *item))
    trials = [(refine(task, trial, task.columns(new), at), new) for trial, new in trials[:3]]
    trials = [(trial, new) for trial, new in trials if material(task, trial, new[-1])]
    trial, new = min([*trials, (fit, members)], key=lambda item: price(task, *item))
    return new, trial


def search(task: Problem, start: Fit, seed: int = 0, members: tuple[int, ...] = (), most: int = MOST) -> Selection:
    """Effects added while the test rejects and the refit earns its keep, `most` in all; swaps and cuts follow each.

    The search begins with the effects `members` of `start`.
    """
    fit, at = settle(task, start, task.columns(members))
    left = first = scores(task, at, fit.theta, members, seed)
    while len(members) < most and left.p_value < LEVEL:
        grown, trial = best_of(task, fit, members, at, left.gain)
        new, trial = prune(task, *swap(task, grown, trial))
        trial, there = settle(task, trial, task.columns(new))
        if price(task, trial, new) >= price(task, fit, members):
            break
        members, fit, at = new, trial, there
        left = scores(task, at, fit.theta, members, seed + len(members))
    return Selection(members, fit, at, left, task, start, first)


def without(
    task: Problem, fit: Fit, members: tuple[int, ...], gone: int, near: Followed
) -> tuple[tuple[int, ...], Fit]:
    """The hypothesis refitted without the effect `gone`; `near` are the derivatives of a fit nearby."""
    theta, rest = fit.theta.copy(), tuple(i for i in members if i != gone)
    theta[task.columns((gone,))] = task.start[task.columns((gone,))]
    return rest, refine(task, priced(task, theta), task.columns(rest), near)


def swap(task: Problem, members: tuple[int, ...], fit: Fit) -> tuple[tuple[int, ...], Fit]:
    """Each earlier member in turn gives way to the outsider that suits its place best, where that lowers the price."""
    for old in members[:-1]:
        rest, base = without(task, fit, members, old, around(task, fit))
        base, at = settle(task, base, task.columns(rest))
        left = scores(task, at, base.theta, rest, 0)
        new, trial = best_of(task, base, rest, at, left.gain)
        if price(task, trial, new) < price(task, fit, members) - 1.0:
            members, fit = new, trial
    return members, fit


def prune(task: Problem, members: tuple[int, ...], fit: Fit) -> tuple[tuple[int, ...], Fit]:
    """Members that are immaterial or not worth their parameters are taken out, the least worth first."""
    while members:
        at, trials = around(task, fit), []
        for one in members:
            rest, trial = without(task, fit, members, one, at)
            trials.append((price(task, trial, rest) if material(task, fit, one) else -np.inf, rest, trial))
        loss, rest, trial = min(trials, key=lambda item: item[0])
        if loss >= price(task, fit, members):
            break
        members, fit = rest, trial
    return members, fit
