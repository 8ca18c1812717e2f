"""Score tests of effects: scores, their test at a family-wise rate, and the fall of the cost they promise.

Scores are summed over blocks of time, and blocks get random signs: the largest of all |T| under these signs is what
chance gives whatever the dependence within a block and between effects (Romano and Wolf 2005; Cameron, Gelbach and
Miller 2008).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from scipy.stats import chi2, norm
from scipy.stats import t as student

from driftjax.diagnosis.fit import Problem, information
from driftjax.diagnosis.runs import Linearisation

DRAWS = 1999  # of the random signs
DISTINCT = 0.999  # cosine of two parameters' scores from which a pair is one
CONDITION = 1e-8  # share of an effect's information that must be its own for it to be testable


class Scores(NamedTuple):
    """Score tests of all effects that are not selected."""

    H: np.ndarray  # (K, K) information of all parameters
    blocks: np.ndarray  # (C, K) score of each block
    T: np.ndarray  # (K,) studentised scores, 0 for members and for signs that an effect cannot have
    joint: np.ndarray  # (E,) as |T|, all parameters of an effect together; 0 where it has one, or one of one sign only
    gain: np.ndarray  # (E,) fall of the cost that each effect promises, 0 for members
    null_max: np.ndarray  # (DRAWS,) largest |T| or joint score that random signs gave, in ascending order
    effective: np.ndarray  # (C, k) scores of each block of the k parameters tested, the selected ones projected out
    seed: int  # of the random signs

    @property
    def p_value(self) -> float:
        """Return the probability that chance gives the largest score."""
        return self._rarity(max(np.abs(self.T).max(initial=0.0), self.joint.max(initial=0.0)))

    def p_value_of(self, effect: int, columns: np.ndarray) -> float:
        """Return the p-value of one effect with the parameters `columns`, adjusted for all effects tested.

        That is the probability that chance gives any effect a score as large (single-step max-T; Westfall and Young
        1993).
        """
        return self._rarity(max(np.abs(self.T[columns]).max(), self.joint[effect]))

    def _rarity(self, size: float) -> float:
        return float((1 + np.sum(self.null_max >= size)) / (DRAWS + 1))

    @property
    def threshold(self) -> float:
        """Return the score that chance exceeds in 5 % of data sets."""
        return float(np.quantile(self.null_max, 0.95))


def sums_by_block(problem: Problem, e: ArrayLike, J: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return information (K, K) and scores by block (C, K) of innovations (P, T, 3), derivatives (P, T, 3, K)."""
    e, J = np.asarray(e), np.asarray(J)
    blocks = np.zeros((problem.data.num_blocks, J.shape[-1]))
    np.add.at(blocks, problem.data.block, np.einsum("ptik,pti->ptk", J, e))
    return information(J), blocks


def partial_out(H: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the matrix (K, K) that projects the parameters `columns` out of scores: effective score = blocks @ it."""
    P = np.eye(len(H))
    if len(columns):
        HS = H[np.ix_(columns, columns)]
        P[columns] -= np.linalg.solve(HS + 1e-12 * np.trace(HS) * np.eye(len(HS)), H[columns])
    return P


def scores(problem: Problem, at: Linearisation, theta: np.ndarray, selected: tuple[int, ...], seed: int) -> Scores:
    """Test all effects outside `selected` at the fit that the linearisation `at` belongs to."""
    H, blocks = sums_by_block(problem, at.e, at.J)
    columns = problem.columns(selected)
    P = partial_out(H, columns)
    effective, information = blocks @ P, P.T @ H @ P
    own = np.diag(information) > CONDITION * np.diag(H)
    own[columns] = False
    U = effective.sum(axis=0)
    allowed = ((U >= 0) | (problem.lower < theta)) & ((U <= 0) | (problem.upper > theta))
    T = np.where(allowed, studentised(effective, own), 0.0)
    one_sided = problem.lower >= theta
    each = {i: problem.columns((i,)) for i in range(len(problem.effects)) if i not in selected}
    together = {i: c for i, c in each.items() if len(c) > 1 and own[c].all() and not one_sided[c].any()}
    joint = np.zeros(len(problem.effects))
    for i, c in together.items():
        joint[i] = joint_score(effective[:, c], U[None, c])[0]
    chance = null_max_scores(effective, own, one_sided, seed, list(together.values()))
    gains = np.array([_gain(problem, information, U, T, i, selected) for i in range(len(problem.effects))])
    return Scores(H, blocks, T, joint, gains, chance, effective[:, own], seed)


def studentised(effective: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return the sum of the scores (C, K) over the root of their sum of squares; 0 where not `own`."""
    spread = np.sqrt((effective**2).sum(axis=0))
    return np.where(own, effective.sum(axis=0) / np.where(own, spread, 1.0), 0.0)


def joint_score(effective: np.ndarray, U: np.ndarray) -> np.ndarray:
    """Return the joint score of sums `U` (n, k) of k scores (C, k), as the |T| of one parameter of equal p-value.

    Hotelling's statistic with the sum of squares of the blocks, which random signs leave as it is.
    """
    squares = np.einsum("ni,ij,nj->n", U, np.linalg.pinv(effective.T @ effective, hermitian=True), U)
    return norm.isf(chi2.sf(squares, U.shape[1]) / 2)


def pair_p_value(effective: np.ndarray, seed: int) -> float:
    """Return the probability that chance gives any pair of scores (C, k) as large a joint score, Hotelling's.

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
    drawn = largest(signs @ unit)
    return float((1 + np.sum(drawn >= largest(unit.sum(axis=0)[None])[0])) / (DRAWS + 1))


def null_max_scores(
    effective: np.ndarray, own: np.ndarray, one_sided: np.ndarray, seed: int, together: Sequence[np.ndarray] = ()
) -> np.ndarray:
    """Return the largest score (DRAWS,) under random signs of the blocks, ascending.

    It is that of |T|, where `one_sided` scores count only if positive, and of the joint scores of `together`.
    """
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (DRAWS, len(effective)))
    drawn = (signs @ effective[:, own]) / np.sqrt((effective[:, own] ** 2).sum(axis=0))
    drawn = np.where(one_sided[own], np.maximum(drawn, 0.0), np.abs(drawn))
    joint = [joint_score(effective[:, c], signs @ effective[:, c]) for c in together]
    return np.sort(np.max([drawn.max(axis=1, initial=0.0), *joint], axis=0))


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
    few clusters (Cameron and Miller 2015, Eq. 12).
    """
    inverse = np.linalg.inv(H[np.ix_(columns, columns)])
    U = blocks[:, columns]
    C = len(U)
    robust = inverse @ (U.T @ U) @ inverse * C / max(C - len(columns), 1)
    scale = np.sqrt(np.maximum(np.diag(robust) / np.diag(inverse), 1.0))
    return inverse * np.outer(scale, scale)


def half_widths_from(H: np.ndarray, blocks: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the half-widths (k,) of the 95 % intervals of the parameters `columns`, from the robust `covariance`."""
    spread = np.sqrt(np.diag(covariance(H, blocks, columns)))
    return student.ppf(0.975, max(len(blocks) - len(columns), 1)) * spread


def overdispersion(H: np.ndarray, blocks: np.ndarray, columns: np.ndarray) -> float:
    """Return how many times their information the scores of the parameters `columns` vary by, at least 1.

    Mean eigenvalue of H^-1 (U'U) with the correction of `covariance` for few blocks: the first-order correction of a
    likelihood ratio whose samples depend on each other (Varin, Reid and Firth 2011, Sec. 2.3), and the c-hat of QAIC
    (Burnham and Anderson 2002, Sec. 2.5).
    """
    U, C = blocks[:, columns], len(blocks)
    ratio = np.trace(np.linalg.solve(H[np.ix_(columns, columns)], U.T @ U)) / len(columns)
    return float(max(ratio * C / max(C - len(columns), 1), 1.0))
