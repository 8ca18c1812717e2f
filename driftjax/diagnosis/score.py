"""Test effects by their scores, at a family-wise error rate, and predict by how much each lowers the cost.

Scores are summed over blocks of time, and blocks get random signs: the largest of all |T| under these signs is what
chance gives whatever the dependence within a block and between effects (Romano and Wolf 2005; Cameron, Gelbach and
Miller 2008).

|T| cannot exceed the sum of the blocks' shares in it: where two blocks say most it is small, however well all agree.
How rare a score is by itself is therefore told by a normal number that random signs of its own blocks exceed as seldom
(Robinson 1982). Naming goes by the largest |T|: it asks for more than that all blocks agree a little, as they do where
a model is wrong in a way that no effect has.

An effect that acts in few blocks (a power limit, a patch of road) cannot be rare in this sense. It is tested by its
score over the standard deviation that follows from information and dispersion, without the block of the largest score.
Both tests share the family-wise rate.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from scipy.special import chdtrc, chdtri, ndtr, ndtri, stdtr, stdtrit

from driftjax.diagnosis.fit import Problem, information
from driftjax.diagnosis.noise import PRIOR
from driftjax.diagnosis.runs import Linearisation

DRAWS = 1999  # of the random signs
DISTINCT = 0.999  # cosine of two parameters' scores from which a pair is one
FEW = 12.0  # blocks below which an effect acts in few
FEW_SHARE = 0.2  # of the family-wise rate that is spent on these, where there are any
FREEDOM = 10  # degrees of freedom of their dispersion, at least
COLOUR = 0.9  # quantile of the dispersions of other effects that theirs is at least
MEDIAN = float(chdtri(1, 0.5))  # of the square of a standard normal number
NONE = 1e-9  # information in typical sizes below which the data hold none
CONDITION = 1e-8  # share of an effect's information that must be its own for it to be testable
TILTS = np.concatenate([[0.0], np.geomspace(0.05, 1e3, 48)])  # at which sums with random signs are approximated
ROUNDED = 1e-12  # eigenvalue of an information matrix, over the largest, that is but rounding


class Scores(NamedTuple):
    """Score tests of all effects that are not selected."""

    H: np.ndarray  # (K, K) information of all parameters
    blocks: np.ndarray  # (C, K) score of each block
    T: np.ndarray  # (K,) studentised scores, 0 for members and for signs that an effect cannot have
    joint: np.ndarray  # (E,) as |T|, all parameters of an effect together; 0 where it has one, or one of one sign only
    gain: np.ndarray  # (E,) predicted fall of the cost with each effect, 0 for members
    null_max: np.ndarray  # (DRAWS,) largest |T| or joint score that random signs gave, in ascending order
    effective: np.ndarray  # (C, k) scores of each block of the k parameters tested, the selected ones projected out
    seed: int  # of the random signs
    few: np.ndarray | None = (
        None  # (K,) p-value of what acts in few blocks among these, 1 elsewhere; None: nothing does
    )
    rarity: np.ndarray | None = None  # (K,) T as normal numbers that random signs exceed as seldom; None: T itself

    @property
    def p_value(self) -> float:
        """Return the probability that chance gives the largest score."""
        largest = max(np.abs(self.T).max(initial=0.0), self.joint.max(initial=0.0))
        return self._either(self._rarity(largest), np.arange(len(self.T)))

    def p_value_of(self, effect: int, columns: np.ndarray) -> float:
        """Return the p-value of one effect with the parameters `columns`, adjusted for all effects tested.

        That is the probability that chance gives any effect a score as large (single-step max-T; Westfall and Young
        1993).
        """
        return self._either(self._rarity(max(np.abs(self.T[columns]).max(), self.joint[effect])), columns)

    def single_p_value(self, effect: int, columns: np.ndarray) -> float:
        """Return the p-value of one effect alone, not adjusted for the others, from the tail of a normal distribution.

        Random signs cannot give ones as small as a false discovery rate needs.
        """
        return self._tail(self.T, effect, columns)

    def own_p_value(self, effect: int, columns: np.ndarray) -> float:
        """Return the p-value of one effect alone as its own blocks give it, not as if they were many and alike."""
        return self._tail(self.T if self.rarity is None else self.rarity, effect, columns)

    def _tail(self, scores: np.ndarray, effect: int, columns: np.ndarray) -> float:
        size = max(np.abs(scores[columns]).max(), self.joint[effect])
        return self._either(min(2 * float(ndtr(-size)) * len(columns), 1.0), columns)

    def _either(self, p_value: float, columns: np.ndarray) -> float:
        """Return the p-value of both tests together, where the test with random signs gives `p_value`."""
        if self.few is None:
            return p_value
        return min(p_value / (1 - FEW_SHARE), float(self.few[columns].min()) / FEW_SHARE, 1.0)

    def _rarity(self, size: float) -> float:
        return float((1 + np.sum(self.null_max >= size)) / (DRAWS + 1))

    @property
    def threshold(self) -> float:
        """Return the score that chance exceeds in 5 % of data sets."""
        return float(np.quantile(self.null_max, 0.95))


def sums_by_block(problem: Problem, e: ArrayLike, J: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return information (K, K) and scores by block (C, K) of innovations (P, T, 3), derivatives (P, T, 3, K)."""
    e, J = np.asarray(e), np.asarray(J)
    return information(J), sum_by_block(problem, np.einsum("ptik,pti->ptk", J, e))


def sum_by_block(problem: Problem, values: np.ndarray) -> np.ndarray:
    """Return the sums (C, K) over blocks of `values` (P, T, K)."""
    sums = np.zeros((problem.data.num_blocks, values.shape[-1]))
    np.add.at(sums, problem.data.block, values)
    return sums


def partial_out(H: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the matrix (K, K) that projects the parameters `columns` out of scores: effective score = blocks @ it."""
    P = np.eye(len(H))
    if len(columns):
        HS = H[np.ix_(columns, columns)]
        P[columns] -= np.linalg.solve(HS + 1e-12 * np.trace(HS) * np.eye(len(HS)), H[columns])
    return P


def scores(
    problem: Problem, linearisation: Linearisation, theta: np.ndarray, selected: tuple[int, ...], seed: int
) -> Scores:
    """Test all effects outside `selected` at the fit that the `linearisation` belongs to."""
    H, blocks = sums_by_block(problem, linearisation.e, linearisation.J)
    columns = problem.columns(selected)
    P = partial_out(H, columns)
    effective, information = blocks @ P, P.T @ H @ P
    own = np.diag(information) > CONDITION * np.diag(H)
    own[columns] = False
    U = effective.sum(axis=0)
    allowed = ((U >= 0) | (problem.lower < theta)) & ((U <= 0) | (problem.upper > theta))
    T = np.where(allowed, studentised_scores(effective, own), 0.0)
    one_sided = problem.lower >= theta
    each = {i: problem.columns((i,)) for i in range(len(problem.effects)) if i not in selected}
    together = {i: c for i, c in each.items() if len(c) > 1 and own[c].all() and not one_sided[c].any()}
    joint = np.zeros(len(problem.effects))
    for i, c in together.items():
        joint[i] = joint_score(effective[:, c], U[None, c])[0]
    chance = null_max_scores(effective, own, one_sided, seed, list(together.values()))
    gains = np.array([_gain(problem, information, U, T, i, selected) for i in range(len(problem.effects))])
    few = few_block_p_values(
        problem, effective, np.asarray(linearisation.J) @ P if selected else np.asarray(linearisation.J), own, one_sided
    )
    few = None if few is None else np.where(allowed, few, 1.0)
    rarity = np.zeros(len(T))
    rarity[own] = np.where(allowed[own], normal_scores(effective[:, own], U[None, own])[0], 0.0)
    return Scores(H, blocks, T, joint, gains, chance, effective[:, own], seed, few, rarity)


def benjamini_yekutieli(p_values: np.ndarray, rate: float) -> np.ndarray:
    """Return which hypotheses (n,) are rejected at a false discovery `rate`, for `p_values` (n,) of any dependence.

    Benjamini and Yekutieli (2001), Theorem 1.3.
    """
    n = len(p_values)
    limit = rate * np.arange(1, n + 1) / (n * np.sum(1 / np.arange(1, n + 1)))
    passing = np.flatnonzero(np.sort(p_values) <= limit)
    return p_values <= (limit[passing[-1]] if len(passing) else -1.0)


def few_block_p_values(
    problem: Problem, effective: np.ndarray, J: np.ndarray, own: np.ndarray, one_sided: np.ndarray
) -> np.ndarray | None:
    """Return p-values (K,), adjusted by Bonferroni, of effects that act in few blocks; 1 elsewhere, None without any.

    From effective scores by block (C, K) and effective derivatives (P, T, c, K). A block's score varies by its
    information times the `block_dispersion` of the others'. The block that says most for an effect is left out, so
    that none decides alone.
    """
    known = sum_by_block(problem, np.einsum("ptik,ptik->ptk", J, J))
    num = known.sum(axis=0) ** 2 / np.maximum((known**2).sum(axis=0), np.finfo(float).tiny)
    rare, common = own & (num < FEW), own & (num >= FEW)
    if not rare.any() or not common.any():
        return None
    colour, p_values = score_dispersion(effective[:, common], known[:, common]), np.ones(len(own))
    for k in np.flatnonzero(rare):
        s, total = effective[:, k], known[:, k].sum()
        cross = sum_by_block(problem, np.einsum("ptij,pti->ptj", J[..., common], J[..., k]))
        about = effective[:, common] - cross * (s.sum() / total)  # with its own fit taken out
        variance = known[:, k] * np.maximum(block_dispersion(about, known[:, common]), colour)
        acts = known[:, k] > CONDITION * total
        rest, left = variance.sum() - variance[acts], np.sign(s.sum()) * (s.sum() - s[acts])
        least = (left / np.sqrt(np.maximum(rest, np.finfo(float).tiny))).min() if acts.sum() > 1 else 0.0
        p_values[k] = min(rare.sum() * (1 if one_sided[k] else 2) * stdtr(FREEDOM, -max(least, 0.0)), 1.0)
    return p_values


def score_dispersion(effective: np.ndarray, known: np.ndarray) -> float:
    """Return the overdispersion of scores (C, k): block variance over information, each about its own fit; at least 1.

    That of the effects that vary most but for a tenth, with leverages (MacKinnon and White 1985); `known` (C, k) is the
    information by block.
    """
    total = known.sum(axis=0)
    squares = (effective - known * (effective.sum(axis=0) / total)) ** 2
    each = squares.sum(axis=0) / (total - (known**2).sum(axis=0) / total)
    return max(float(np.quantile(each, COLOUR)), 1.0)


def block_dispersion(effective: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the overdispersion (C,) of each block's scores (C, k): the median of squared score over information."""
    there = known > CONDITION * known.sum(axis=0)
    ratio = np.where(there, effective**2 / np.where(there, known, 1.0), np.nan)
    some = there.any(axis=1)
    dispersion = np.zeros(len(known))
    dispersion[some] = np.nanmedian(ratio[some], axis=1) / MEDIAN
    return dispersion


def studentised_scores(effective: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return the studentised scores (K,): sums over blocks (C, K) over their root sum of squares; 0 unless `own`."""
    spread = np.sqrt((effective**2).sum(axis=0))
    return np.where(own, effective.sum(axis=0) / np.where(own, spread, 1.0), 0.0)


def normal_scores(effective: np.ndarray, U: np.ndarray) -> np.ndarray:
    """Return sums `U` (n, k) of scores by block (C, k) as normal numbers that random signs exceed as seldom.

    The signed root of twice the large-deviation rate of such sums, the leading term of their saddlepoint approximation
    (Robinson 1982, J. R. Stat. Soc. B 44); U over its root sum of squares where blocks are many and alike.
    """
    size = np.sqrt((effective**2).sum(axis=0))
    unit, T = np.abs(effective) / size, U / size
    x = TILTS[:, None, None] * unit
    mean = np.einsum("ck,gck->gk", unit, np.tanh(x))
    rate = TILTS[:, None] * mean - (x + np.log1p(np.exp(-2 * x)) - np.log(2)).sum(axis=1)
    root = np.sqrt(2 * np.maximum(rate, 0.0))
    each = [np.interp(np.abs(T[:, k]), mean[:, k], root[:, k]) for k in range(len(size))]
    return np.sign(T) * np.stack(each, axis=1) if each else T


def joint_score(effective: np.ndarray, U: np.ndarray) -> np.ndarray:
    """Return the joint score of sums `U` (n, k) of k scores (C, k), as the |T| of one parameter of equal p-value.

    Hotelling's statistic with the sum of squares of the blocks, which random signs leave as it is.
    """
    squares = np.einsum("ni,ij,nj->n", U, np.linalg.pinv(effective.T @ effective, hermitian=True), U)
    return -ndtri(chdtrc(U.shape[1], squares) / 2)


def pair_p_value(effective: np.ndarray, seed: int) -> float:
    """Return the probability that chance gives some pair of scores (C, k) a joint score (Hotelling's) this large.

    Two effects that cancel in each other's single scores stand out in the joint one.
    """
    size = np.sqrt((effective**2).sum(axis=0))
    unit = effective / size
    i, j = np.triu_indices(len(size), 1)
    cosine = np.einsum("ck,cl->kl", unit, unit)[i, j]
    apart = np.abs(cosine) < DISTINCT
    i, j, cosine = i[apart], j[apart], cosine[apart]
    largest = lambda z: ((z[:, i] ** 2 + z[:, j] ** 2 - 2 * cosine * z[:, i] * z[:, j]) / (1 - cosine**2)).max(
        axis=1, initial=0.0
    )
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (DRAWS, len(effective)))
    by_chance = largest(signs @ unit)
    return float((1 + np.sum(by_chance >= largest(unit.sum(axis=0)[None])[0])) / (DRAWS + 1))


def null_max_scores(
    effective: np.ndarray, own: np.ndarray, one_sided: np.ndarray, seed: int, together: Sequence[np.ndarray] = ()
) -> np.ndarray:
    """Return the largest score (DRAWS,) under random signs of the blocks, ascending.

    It is that of |T|, where `one_sided` scores count only if positive, and of the joint scores of `together`.
    """
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (DRAWS, len(effective)))
    by_chance = (signs @ effective[:, own]) / np.sqrt((effective[:, own] ** 2).sum(axis=0))
    by_chance = np.where(one_sided[own], np.maximum(by_chance, 0.0), np.abs(by_chance))
    joint = [joint_score(effective[:, c], signs @ effective[:, c]) for c in together]
    return np.sort(np.max([by_chance.max(axis=1, initial=0.0), *joint], axis=0))


def _gain(
    problem: Problem, H: np.ndarray, U: np.ndarray, T: np.ndarray, effect: int, selected: tuple[int, ...]
) -> float:
    """Return the fall of the cost by the best linear step in the parameters of one effect with allowed sign."""
    columns = problem.columns((effect,))
    columns = columns[T[columns] != 0]
    if effect in selected or not len(columns):
        return 0.0
    part = H[np.ix_(columns, columns)]
    return float(U[columns] @ np.linalg.solve(part + 1e-9 * np.trace(part) * np.eye(len(part)), U[columns]))


def covariance(H: np.ndarray, blocks: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the covariance of the parameters `columns`, from information (K, K) and scores by block (C, K).

    It is robust to dependence within blocks, never below the model's own: sandwich with the correction C / (C - k) of
    few clusters (Cameron and Miller 2015, Eq. 12). That of parameters without information, as of the delay of a channel
    that the log lacks, is the prior's.
    """
    known = H[np.ix_(columns, columns)]
    inverse = np.linalg.inv(known + np.diag((np.diag(known) < NONE) / PRIOR**2))
    U = blocks[:, columns]
    C = len(U)
    robust = inverse @ (U.T @ U) @ inverse * C / max(C - len(columns), 1)
    scale = np.sqrt(np.maximum(np.diag(robust) / np.diag(inverse), 1.0))
    return inverse * np.outer(scale, scale)


def half_widths_from(H: np.ndarray, blocks: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the half-widths (k,) of the 95 % intervals of the parameters `columns`, from the robust `covariance`."""
    spread = np.sqrt(np.diag(covariance(H, blocks, columns)))
    return stdtrit(max(len(blocks) - len(columns), 1), 0.975) * spread


class ParameterSpread(NamedTuple):
    """Uncertainty of fitted parameters, in typical sizes."""

    half_width: np.ndarray  # (k,) of the 95 % intervals
    covariance: np.ndarray  # (k, k)


def spread_of(H: np.ndarray, blocks: np.ndarray, columns: np.ndarray) -> ParameterSpread:
    """Return the uncertainty of the parameters `columns`, from information (K, K) and scores by block (C, K)."""
    return ParameterSpread(half_widths_from(H, blocks, columns), covariance(H, blocks, columns))


def overdispersion(H: np.ndarray, blocks: np.ndarray, columns: np.ndarray) -> float:
    """Return the overdispersion of the scores of `columns`: their variance over their information, at least 1.

    Mean eigenvalue of H^-1 (U'U) with the correction of `covariance` for few blocks: the first-order correction of a
    likelihood ratio whose samples depend on each other (Varin, Reid and Firth 2011, Sec. 2.3), and the c-hat of QAIC
    (Burnham and Anderson 2002, Sec. 2.5). Directions without information have neither, and do not count.
    """
    U, C, own = blocks[:, columns], len(blocks), H[np.ix_(columns, columns)]
    inverse = np.linalg.pinv(own, ROUNDED, hermitian=True)
    rank = max(round(np.sum(inverse * own)), 1)
    ratio = np.sum(inverse * (U.T @ U)) / rank
    return float(max(ratio * C / max(C - rank, 1), 1.0))
