"""Differences between two logs by linear algebra alone: chance, what both share, signs, what one log alone says."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from driftjax.diagnosis.contrast import (
    Contrast,
    Information,
    contrast_of,
    intervals,
    probabilities,
    search_differences,
)
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import Errors
from driftjax.diagnosis.gap import closed_share, overlaps
from driftjax.diagnosis.noise import PRIOR
from driftjax.logs import Run

C, N, K, RUNS = 40, 12, 7, 5  # blocks, measurements in each, effects, runs of each log
NOTHING: Any = None


def problem(owner: np.ndarray = np.arange(K)) -> Problem:
    model: Any = SimpleNamespace(effects=(NOTHING,) * (owner.max() + 1))
    known = np.zeros(K), owner, frozenset[str](), np.ones(K, bool)
    return Problem(model, NOTHING, np.full(K, -4.0), np.full(K, 4.0), *known, NOTHING, NOTHING)


MIXED = np.eye(K) + 0.4 * np.random.default_rng(8).normal(size=(K, K))  # manoeuvres are alike: so are derivatives


def log_of(rng, theta: np.ndarray, varies: float = 0.0, coloured: bool = False, excited=None) -> Information:
    """A log of a car whose true parameters are `theta` (K,), about a fit of the nominal car, 0."""
    J = rng.normal(size=(C, N, K)) @ MIXED * (np.ones(K) if excited is None else excited)
    run = np.arange(C) * RUNS // C
    size = theta + varies * rng.normal(size=(RUNS, K))[run]
    e = np.einsum("cnk,ck->cn", J, size) + rng.normal(size=(C, N))
    if coloured:
        e += 1.5 * np.einsum("cnk,ck->cn", J, rng.normal(size=(C, K))) / np.sqrt(N)
    return Information(np.zeros(K), np.einsum("cni,cnj->cij", J, J), np.einsum("cni,cn->ci", J, e), run)


def contrast(rng, a: np.ndarray, b: np.ndarray, **options) -> Contrast:
    return contrast_of(problem(), log_of(rng, a, **options), log_of(rng, b, **options))


SHARED = np.array([1.5, 0.0, -1.0, 0.0, 0.3, 0.0, 0.0])
CHANGE = np.array([0.0, 0.0, 0.0, -0.8, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("options", [{}, {"coloured": True}, {"varies": 0.4}], ids=["white", "coloured", "by run"])
def test_what_both_logs_share_is_no_difference(options, cases=25):
    rng = np.random.default_rng(1)
    searches = [search_differences(contrast(rng, SHARED, SHARED, **options), 0, 8) for _ in range(cases)]
    assert np.mean([len(one) > 0 for one in searches]) <= 0.12


def test_what_changed_is_named_with_its_size_and_what_is_shared_is_not(cases=15):
    rng, inside = np.random.default_rng(2), []
    for _ in range(cases):
        one = contrast(rng, SHARED, SHARED + CHANGE)
        assert 3 in (named := search_differences(one, 0, 8)) and len(named) == 1
        value, width = intervals(one, named)
        inside.append(abs(value[0] - CHANGE[3]) < width[0])
        assert width[0] < 0.3 and probabilities(one, named, 3)[3] > 0.99
    assert np.mean(inside) > 0.85


def test_swapped_logs_give_the_opposite_difference():
    rng = np.random.default_rng(3)
    one = contrast(rng, SHARED, SHARED + CHANGE)
    other = contrast_of(problem(), one.second, one.first)
    named = search_differences(one, 0, 8)
    assert named == search_differences(other, 0, 8) == (3,)
    (there, width), (back, same) = intervals(one, named), intervals(other, named)
    np.testing.assert_allclose([there, width], [-back, same], atol=2e-3)
    np.testing.assert_allclose(one.shared(CHANGE) + CHANGE, other.shared(-CHANGE), atol=2e-3)


def test_what_one_log_alone_excites_is_no_difference():
    """The other one does not say that it lacks it."""
    rng, excited = np.random.default_rng(4), np.where(np.arange(K) == 3, 1e-3, 1.0)
    a = log_of(rng, SHARED, excited=excited)
    assert search_differences(contrast_of(problem(), a, log_of(rng, SHARED + CHANGE)), 0, 8) == ()


def test_a_difference_is_named_by_the_parameters_that_the_logs_say_something_of():
    """As delays of the sensors, of which one is that of a channel that no log has."""
    rng, owner, excited = (
        np.random.default_rng(9),
        np.array([0, 1, 2, 3, 3, 4, 5]),
        np.where(np.arange(K) == 4, 0.0, 1.0),
    )
    logs = [log_of(rng, theta * excited, excited=excited) for theta in (SHARED, SHARED + CHANGE)]
    one = contrast_of(problem(owner), *logs)
    assert search_differences(one, 0, 8) == (3,)
    (value, nothing), (width, prior) = intervals(one, (3,))
    assert value == pytest.approx(CHANGE[3], abs=width) and width < 0.3
    assert nothing == pytest.approx(0.0, abs=1e-9) and prior > 1.9 * PRIOR
    np.testing.assert_allclose(intervals(contrast_of(problem(), *logs), (3,)), [[value], [width]], rtol=0.03)


def errors(V: float, r: float, seed: int = 5) -> Errors:
    """Errors of V and r at four horizons, those of beta unknown."""
    noise = np.random.default_rng(seed).chisquare(1, (200, 4, 3))
    return Errors(noise * np.array([V, np.nan, r]) ** 2, (), np.arange(200) // 4, np.zeros(200, int))


def test_the_share_of_the_gap_that_is_closed_counts_all_channels_together():
    own = errors(1.0, 1.0)
    most, none = (
        closed_share(errors(2.0, 2.0), corrected, own, 0) for corrected in (errors(1.2, 1.0), errors(2.0, 2.0))
    )
    assert most and most.value == pytest.approx(1 - 0.44 / 6, abs=0.03) and most.ci95[0] > 0.9 and most.remaining < 0.2
    assert none and none.value == pytest.approx(0.0, abs=1e-9) and none.remaining == pytest.approx(0.75)
    # one channel worse, the other one better: no gap, and nothing left, though a channel is worse
    alike = closed_share(errors(1.2, 0.7), errors(1.2, 0.7), own, 0)
    assert alike and np.isnan(alike.value) and alike.remaining_ci95[0] < 0.1
    short = errors(np.nan, np.nan)
    assert closed_share(short, short, short, 0) is None


def test_the_range_of_a_channel_is_shared_as_far_as_its_samples_are():
    t, same = np.arange(1000) * 0.01, np.linspace(0.0, 1.0, 1000)
    run = lambda V: (Run("a", t, V, same, same, same, 0 * same, 0.01),)
    shared = overlaps(run(5 + same), run(5.5 + same))
    assert shared["V"].share == pytest.approx(0.5, abs=0.06) and shared["beta"].share == pytest.approx(1.0)
    assert shared["V"].second == pytest.approx((5.55, 6.45), abs=0.01) and shared["Fxr"].share == pytest.approx(1.0)
    assert "V" not in overlaps(run(5 + same), run(np.nan * same))
    assert overlaps(run(5 + same), run(7 + same))["V"].share < 0.02
