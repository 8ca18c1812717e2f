"""Classify the identifiability of each fitted parameter, and the data that decided it.

Parameters are called dead, flat, traded off or at a bound as in reports of identifiability (Raue et al. 2009; Belsley,
Kuh and Welsch 1980), from the information of the data, in typical sizes.
"""

from typing import NamedTuple

import numpy as np

DEAD = 0.1  # information over that of the prior, others known, below which the data are uninformative
FLAT = 1.0  # half-width of the 95 % interval from which a parameter is poorly identified [typical sizes]
TRADE_OFF = 0.95  # correlation from which a parameter is not distinguishable from others
PARTNERS = 3  # parameters that one is traded off with, at most


class Identifiability(NamedTuple):
    """Identifiability of one parameter."""

    shares: np.ndarray  # (S+1,) of the variance of its estimate, by kind of stretch, the prior last
    dead: bool
    flat: bool
    trades_off_with: tuple[int, ...]  # numbers of other parameters


def identifiability(
    information: np.ndarray, prior: np.ndarray, precision: np.ndarray, half_width: np.ndarray
) -> tuple[Identifiability, ...]:
    """Classify k parameters by their `information` (S, k, k), by kind of stretch.

    `prior` (k,) is the precision before any data, `precision` (k, k) what the data give, and `half_width` (k,) that of
    the 95 % intervals, in typical sizes.
    """
    shares, known = stretch_shares(information, prior), np.einsum("skk->k", information) / prior
    return tuple(
        Identifiability(shares[:, j], bool(known[j] < DEAD), bool(half_width[j] > FLAT), trade_offs(precision, j))
        for j in range(len(half_width))
    )


def stretch_shares(information: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Return the variance shares (S+1, k) of each estimate by kind of stretch, from `information` (S, k, k).

    With all data at once, an estimate is a weighted sum of the scores of all stretches and of the prior, which comes
    last; shares are those of the variance of that sum.
    """
    every = np.concatenate([information, np.diag(prior)[None]])
    P = np.linalg.inv(every.sum(axis=0))
    return np.einsum("ij,sjk,ki->si", P, every, P, optimize=True) / np.diag(P)


def trade_offs(precision: np.ndarray, j: int) -> tuple[int, ...]:
    """Return the fewest parameters that must be known for parameter `j` to be distinguishable, at most `PARTNERS`.

    Its multiple correlation with them is above `TRADE_OFF`, and without them below.
    """
    P, partners = np.linalg.inv(precision), []
    while 1 - 1 / (P[j, j] * precision[j, j]) > TRADE_OFF**2 and len(partners) < PARTNERS:
        removed = P[j] ** 2 / np.maximum(np.diag(P), np.finfo(float).tiny)
        removed[[j, *partners]] = -1.0
        best = int(np.argmax(removed))
        P = P - np.outer(P[:, best], P[best]) / P[best, best]
        partners.append(best)
    return tuple(partners)
