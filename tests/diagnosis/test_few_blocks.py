"""Effects that act in few blocks of time: chance, colour and one bad block do not name them, strength does."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.runs import Linearisation, Pieces
from driftjax.diagnosis.score import Scores, scores

C, LENGTH, K, RARE = 60, 6, 12, 10  # blocks, samples in each, effects; the last two act in few
NOTHING: Any = None
CASES = 100


def problem_of(lower: float) -> Problem:
    data = Pieces(NOTHING, np.zeros(1, int), np.repeat(np.arange(C), LENGTH)[None], C, 0.1)
    model: Any = SimpleNamespace(effects=(NOTHING,) * K)
    known = np.zeros(K), np.arange(K), frozenset[str](), np.ones(K, bool)
    return Problem(model, data, np.full(K, lower), np.full(K, 4.0), *known, NOTHING, NOTHING)


def scores_of(rng, num: int, e: np.ndarray, size: float = 0.0, lower: float = -4.0, selected=()) -> Scores:
    """Scores of twelve effects, the last two of which act in `num` blocks, the last one with `size` in `e` (n, 3)."""
    J = rng.normal(size=(C * LENGTH, 3, K)) @ (np.eye(K) + 0.3 * rng.normal(size=(K, K)))
    J[:, :, RARE:] = rng.normal(size=(C * LENGTH, 3, 2))
    acts = np.isin(np.arange(C), rng.choice(C, num, replace=False))
    J[:, :, RARE:] *= np.repeat(acts, LENGTH)[:, None, None]
    e = e + size * J[:, :, -1]
    members = J[:, :, list(selected)].reshape(e.size, len(selected))
    e = e - (members @ np.linalg.lstsq(members, e.ravel(), rcond=None)[0]).reshape(e.shape)  # fitted, as they are
    at = Linearisation(e[None], J[None], NOTHING, NOTHING)  # type: ignore[arg-type]
    return scores(problem_of(lower), at, np.zeros(K), selected, int(rng.integers(1000)))


def white(rng) -> np.ndarray:
    return rng.normal(size=(C * LENGTH, 3))


def coloured(rng) -> np.ndarray:
    """What is nearly the same for a block, and three times as large in a third of the time."""
    each = np.repeat(rng.normal(size=(C, 3)), LENGTH, axis=0) + 0.3 * white(rng)
    return each * np.where(rng.random(C) < 1 / 3, 3.0, 1.0).repeat(LENGTH)[:, None]


def one_bad_block(rng) -> np.ndarray:
    e = white(rng)
    for at in rng.choice(C, 10, replace=False):
        e[at * LENGTH : (at + 1) * LENGTH] += 8 * rng.normal(size=3)
    return e


@pytest.mark.parametrize("lower", [-4.0, 0.0], ids=["free", "one-sided"])
@pytest.mark.parametrize("made", [white, coloured, one_bad_block])
def test_chance_names_nothing_that_acts_in_few_blocks(made, lower, num=3):
    rng = np.random.default_rng(num)
    p = np.array([(one := scores_of(rng, num, made(rng), lower=lower)).p_value for _ in range(CASES)])
    assert one.few is not None and (one.few[:RARE] == 1).all()
    assert (p < 0.05).mean() <= 0.09


@pytest.mark.parametrize(("num", "size"), [(3, 1.6), (4, 1.4), (6, 1.2)])
@pytest.mark.parametrize("lower", [-4.0, 0.0], ids=["free", "one-sided"])
def test_what_acts_in_three_to_six_blocks_is_found(num, size, lower):
    rng = np.random.default_rng(num)
    results = [scores_of(rng, num, white(rng), size, lower, selected=(0,)) for _ in range(30)]
    last, columns = K - 1, np.array([K - 1])
    assert max(abs(one.T[last]) for one in results) < np.sqrt(num) + 0.05
    rarity = [abs(one.rarity[last]) for one in results if one.rarity is not None]
    assert np.median(rarity) < np.sqrt(2 * num * np.log(2)) + 0.15  # that of `num` signs which agree
    assert np.mean([one.p_value_of(last, columns) < 0.05 for one in results]) > 0.85
    assert np.mean([one.p_value_of(RARE, np.array([RARE])) < 0.05 for one in results]) < 0.15  # not what acts there too


def test_the_signs_alone_decide_where_all_effects_act_in_many_blocks():
    rng = np.random.default_rng(9)
    assert scores_of(rng, C, white(rng)).few is None


def test_a_sign_that_an_effect_cannot_have_is_not_found_in_few_blocks_either():
    rng = np.random.default_rng(10)
    result = scores_of(rng, 4, white(rng), -2.0, lower=0.0)
    assert result.few is not None and result.few[K - 1] == 1
    assert scores_of(rng, 4, white(rng), -2.0).p_value < 0.05
