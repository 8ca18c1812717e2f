"""Beam search on quadratic costs: against brute force, bounds, effects that cancel or stand for two; Shapley shares."""

from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from driftjax.diagnosis.beam import QuadraticCost, beam_search, gains_of_adding, minimise_over
from driftjax.diagnosis.fit import Fit
from driftjax.diagnosis.score import pair_p_value
from driftjax.diagnosis.shapley import shapley_shares
from driftjax.vehicle.effect import EFFECTS
from driftjax.vehicle.effect.families import FAMILIES, FAMILY_OF

PENALTY = 10.0
FREE = np.full(7, np.inf)


def cost_of(J: np.ndarray, y: np.ndarray, lower: np.ndarray = -FREE) -> QuadraticCost:
    """Least squares of `y` (n,) by the columns of `J` (n, 7): six effects, the last with two parameters."""
    columns = (*(np.array([i]) for i in range(5)), np.array([5, 6]))
    return QuadraticCost(float(y @ y), J.T @ y, J.T @ J + 1e-9 * np.eye(7), lower, FREE, columns)


def brute_force(J: np.ndarray, y: np.ndarray, most: int) -> tuple[int, ...]:
    """The set of least penalised cost among all."""
    columns = ([0], [1], [2], [3], [4], [5, 6])

    def penalty(chosen: tuple[int, ...]) -> float:
        c = [k for i in chosen for k in columns[i]]
        return float(np.sum((y - J[:, c] @ np.linalg.lstsq(J[:, c], y, rcond=None)[0]) ** 2)) + PENALTY * len(c)

    return min((s for n in range(1, most + 1) for s in combinations(range(6), n)), key=penalty)


@pytest.mark.parametrize("seed", range(8))
def test_the_best_set_is_that_of_brute_force(seed):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(300, 7)) @ (np.eye(7) + 0.6 * rng.normal(size=(7, 7)))
    psi = np.where(rng.random(7) < 0.5, rng.normal(size=7), 0.0)
    y = J @ psi + rng.normal(size=300)
    assert beam_search(cost_of(J, y), 4, PENALTY)[0].effects == brute_force(J, y, 4)


def test_two_effects_that_cancel_in_single_tests_are_found_together():
    rng = np.random.default_rng(1)
    J = rng.normal(size=(2000, 7))
    J[:, 1] = J[:, 0] + 0.1 * rng.normal(size=2000)
    y = 2.0 * (J[:, 1] - J[:, 0]) + rng.normal(size=2000)
    model = cost_of(J, y)
    single = gains_of_adding(model, ())
    best = beam_search(model, 2, PENALTY)[0]
    assert single[0] < 3 * PENALTY and best.effects == (0, 1) and best.gain > single[:2].max() + 40
    blocks = (J * y[:, None]).reshape(100, 20, 7).sum(axis=1)
    assert pair_p_value(blocks, 0) < 0.01
    noise = (J * rng.normal(size=2000)[:, None]).reshape(100, 20, 7).sum(axis=1)
    assert pair_p_value(noise, 0) > 0.01


def test_one_effect_is_taken_where_two_others_together_do_the_same():
    rng = np.random.default_rng(2)
    J = rng.normal(size=(1000, 7))
    J[:, 2] = 0.7 * J[:, 0] + 0.7 * J[:, 1] + 0.05 * rng.normal(size=1000)
    y = J[:, 2] + rng.normal(size=1000)
    assert beam_search(cost_of(J, y), 3, PENALTY)[0].effects == (2,)


def test_a_parameter_stays_within_its_bounds_and_a_set_that_does_not_need_a_member_is_none():
    rng = np.random.default_rng(3)
    J = rng.normal(size=(1000, 7))
    y = J @ np.array([1.0, -1.0, 0, 0, 0, 0, 0]) + 0.1 * rng.normal(size=1000)
    model = cost_of(J, y, lower=np.where(np.arange(7) == 1, 0.0, -np.inf))
    assert minimise_over(model, (0, 1)) is None
    alone = minimise_over(model, (0,))
    assert alone is not None and alone.psi[0] == pytest.approx(1.0, abs=0.1) and not alone.psi[1:].any()
    assert beam_search(model, 2, PENALTY)[0].effects == (0,)


def test_shares_add_to_one_and_effects_that_do_the_same_share_alike():
    rng, blocks, length = np.random.default_rng(4), 30, 20
    e_of = rng.normal(size=(1, blocks * length, 3))
    J = rng.normal(size=(*e_of.shape, 3))
    J[..., 1] = J[..., 0] + 1e-3 * J[..., 1]
    theta = np.array([0.5, 0.5, 0.5])
    none: Any = None
    data = SimpleNamespace(block=np.repeat(np.arange(blocks), length)[None], num_blocks=blocks)
    problem: Any = SimpleNamespace(
        data=data, start=np.zeros(3), lower=np.full(3, -9.0), upper=np.full(3, 9.0), effects=(none, none, none),
        active=np.ones(3, bool), columns=lambda which: np.array(which, int),
    )  # fmt: skip
    selection: Any = SimpleNamespace(
        selected=(0, 1, 2), fit=Fit(theta, 1.0, e_of), linearisation=SimpleNamespace(e=e_of, J=J)
    )
    shares = shapley_shares(problem, selection)
    assert sum(one.share for one in shares.values()) == pytest.approx(1.0)
    assert shares[0].share == pytest.approx(shares[1].share, rel=0.1) and shares[0].share > 1.5 * shares[2].share
    assert all(one.ci95[0] < one.share < one.ci95[1] for one in shares.values())


def test_every_effect_has_one_family():
    assert set(FAMILY_OF) >= set(EFFECTS) and sum(map(len, FAMILIES.values())) == len(FAMILY_OF)
