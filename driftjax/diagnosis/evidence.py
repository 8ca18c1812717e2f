"""How sure a name is: intervals of its parameters, and the probability that it rather than a rival acts."""

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from driftjax.diagnosis.fit import Problem, information, settle
from driftjax.diagnosis.score import Scores, covariance, partial_out, scores
from driftjax.diagnosis.select import WORTH, Selection, price, without

RIVAL = 0.01  # probability from which a rival is worth telling of
SHARE = 0.01  # of the information on a parameter that a run must have to count in the test of invariance
ALIKE = 0.95  # cosine of two effects' signatures from which the data hardly tell them apart


class Cause(NamedTuple):
    """One named effect."""

    effect: int
    theta: np.ndarray  # (k,) in typical sizes
    half_width: np.ndarray  # (k,) of the 95 % interval
    probability: float
    rivals: dict[int, float]  # effects that might act in its place, with their probabilities
    alike: tuple[int, ...]  # effects whose signature is nearly the same
    invariance: float  # probability that chance makes the runs differ as much in it; 1 for a single run


def causes(task: Problem, found: Selection) -> list[Cause]:
    """Every named effect with its interval, its probability and its rivals."""
    columns = task.columns(found.members)
    if not len(columns):
        return []
    constant, widths = invariance(task, found), half_widths(task, found.scores, found.members)
    each = []
    for member in found.members:
        own = task.columns((member,))
        at = np.searchsorted(columns, own)
        probability, rivals = odds(task, found, member)
        alike = confusable(task, found, member)
        each.append(Cause(member, found.fit.theta[own], widths[at], probability, rivals, alike, constant[member]))
    return each


def half_widths(task: Problem, last: Scores, members: tuple[int, ...]) -> np.ndarray:
    """Half-widths (k,) of the 95 % intervals of the parameters of `members`, in typical sizes."""
    columns = task.columns(members)
    spread = np.sqrt(np.diag(covariance(last.H, last.blocks, columns)))
    return student.ppf(0.975, max(task.data.num_blocks - len(columns), 1)) * spread


def invariance(task: Problem, found: Selection) -> dict[int, float]:
    """Probability that chance alone makes runs ask for a parameter as differently as they do, the least per member.

    A cause has the same size in every run (Peters, Buhlmann and Meinshausen 2016). Scores of each run, all other
    members taken out, over their information make Cochran's Q (1954), in units of what blocks vary by.
    """
    columns, runs = task.columns(found.members), np.unique(task.data.run)
    if len(runs) < 2:
        return dict.fromkeys(found.members, 1.0)
    e, J = np.asarray(found.at.e), np.asarray(found.at.J)[..., columns]
    H = np.array([information(J[task.data.run == run]) for run in runs])
    U = np.array([np.einsum("ptij,pti->j", J[task.data.run == run], e[task.data.run == run]) for run in runs])
    total, blocks = H.sum(axis=0), found.scores.blocks[:, columns]
    least = dict.fromkeys(found.members, 1.0)
    for k, column in enumerate(columns):
        other = np.arange(len(columns)) != k
        w = np.zeros(len(columns))
        w[k], w[other] = 1.0, -np.linalg.solve(total[np.ix_(other, other)], total[other, k])
        size, score = np.einsum("j,rjk,k->r", w, H, w), U @ w
        excess = max(np.sum((blocks @ w) ** 2) / size.sum(), 1.0)
        known = size > SHARE * size.sum()
        Q = np.sum(score[known] ** 2 / size[known]) - score[known].sum() ** 2 / size[known].sum()
        member = int(task.owner[column])
        least[member] = min(least[member], float(chi2.sf(Q / excess, max(known.sum() - 1, 1))))
    return least


def odds(task: Problem, found: Selection, member: int) -> tuple[float, dict[int, float]]:
    """Probability of `member` in its place among all effects, and of the rivals above `RIVAL`.

    Each hypothesis weighs exp(-price / 2), as in the Bayesian information criterion (Schwarz 1978); a rival's price
    is that of its best linear step, which flatters no one but hardly any rival either.
    """
    rest, base = without(task, found.fit, found.members, member, found.at)
    base, at = settle(task, base, task.columns(rest))
    left = scores(task, at, base.theta, rest, 0)
    prices = np.full(len(task.effects), np.inf)
    for i in range(len(prices)):
        if i not in rest and left.gain[i] > 0:
            prices[i] = base.cost - left.gain[i] + WORTH * len(task.columns((*rest, i)))
    prices[member] = price(task, found.fit, found.members)
    weight = np.exp(-0.5 * (prices - prices.min()))
    share = weight / weight.sum()
    rivals = {i: float(share[i]) for i in np.argsort(-share) if i != member and share[i] > RIVAL}
    return float(share[member]), rivals


def confusable(task: Problem, found: Selection, member: int) -> tuple[int, ...]:
    """Effects whose signature in these data, all other members apart, is nearly that of `member`."""
    H = found.scores.H
    P = partial_out(H, task.columns(tuple(i for i in found.members if i != member)))
    own, H = task.columns((member,)), P.T @ H @ P
    alike = []
    for i in range(len(task.effects)):
        columns = task.columns((i,))
        if i in found.members or len(columns) > 1 or len(own) > 1:
            continue
        power = H[own[0], own[0]] * H[columns[0], columns[0]]  # rounding may leave it below 0 where members say it all
        if power > 0 and abs(H[own[0], columns[0]]) > ALIKE * np.sqrt(power):
            alike.append(i)
    return tuple(alike)
