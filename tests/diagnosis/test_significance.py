"""Which named effects are claimed at the family-wise rate, which are exploratory, and which are not named at all."""

import numpy as np
import pytest
from diagnosis.toy import BLOCKS, LENGTH, toy_problem

from driftjax.diagnosis import naming
from driftjax.diagnosis.beam import quadratic_cost
from driftjax.diagnosis.evidence import STRONG, significance
from driftjax.diagnosis.naming import name_effects
from driftjax.diagnosis.score import benjamini_yekutieli, scores
from driftjax.diagnosis.select import Selection, fitted

SIZES = np.array([1.0, 0.9, 0.8, 0.7, 0.6, 0.0, 0.0, 0.0])
RUNS = 6


def residuals(theta: np.ndarray) -> np.ndarray:
    """Residuals of eight effects, five of which act."""
    rng = np.random.default_rng(7)
    J, noise = rng.normal(size=(8, RUNS, BLOCKS * LENGTH, 3)), rng.normal(size=(RUNS, BLOCKS * LENGTH, 3))
    return noise + np.tensordot(SIZES - theta, J, axes=1)


def selection_of(problem, nominal, selected) -> Selection:
    step = fitted(problem, nominal, selected)
    tested = scores(problem, step.linearisation, step.fit.theta, selected, 0)
    return Selection(selected, step.fit, step.linearisation, tested, problem, nominal, tested)


def test_effects_beyond_the_first_are_exploratory_and_chance_is_not_supported(monkeypatch):
    problem, nominal = toy_problem(monkeypatch, residuals, np.full(8, -3.0), np.full(8, 3.0), runs=RUNS)
    selection = selection_of(problem, nominal, (0, 1, 2, 3, 4, 6))
    model = quadratic_cost(problem, selection.fit, selection.linearisation)
    results = significance(problem, selection, model, dict(enumerate(SIZES)))
    assert [i for i, one in results.items() if one.exploratory] == [4, 6]
    assert [i for i, one in results.items() if not one.supported] == [6]
    assert results[6].p_value > 0.05 > results[4].p_value


def test_what_the_false_discovery_rate_does_not_allow_is_left_out(monkeypatch):
    problem, nominal = toy_problem(monkeypatch, residuals, np.full(8, -3.0), np.full(8, 3.0), runs=RUNS)
    crowd = selection_of(problem, nominal, (0, 1, 2, 3, 4, 5, 6))
    monkeypatch.setattr(naming, "search_multistart", lambda *args: (problem, crowd))
    _, selection = name_effects(problem)
    assert selection.selected == (0, 1, 2, 3, 4)
    assert selection.significance is not None and [selection.significance[i].exploratory for i in range(5)] == [
        False
    ] * 4 + [True]
    np.testing.assert_allclose(selection.fit.theta, SIZES, atol=0.1)


def test_the_false_discovery_rate_is_that_of_the_step_up_procedure():
    p = np.array([0.2, 0.001, 0.9, 0.006, 0.03])
    harmonic = 1 + 1 / 2 + 1 / 3 + 1 / 4 + 1 / 5
    assert benjamini_yekutieli(p, 0.1).tolist() == [False, True, False, True, False]  # limits 0.0088, 0.0175, 0.026
    assert 0.006 < 2 * 0.1 / (5 * harmonic) and 0.03 > 3 * 0.1 / (5 * harmonic)
    assert not benjamini_yekutieli(np.full(5, 0.05), 0.1).any()
    assert benjamini_yekutieli(np.array([0.02, 0.021, 0.022]), 0.1).tolist() == [True] * 3  # the last carries the first


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_few_discoveries_are_false(share):
    """Among 40 dependent hypotheses, half or all of which are true."""
    rng, rates = np.random.default_rng(8), []
    for _ in range(300):
        z = 0.7 * rng.normal() + 0.7 * rng.normal(size=40)
        true = np.arange(40) < 40 * share
        z += np.where(true, 0.0, 4.0)
        from_normal = np.exp(-(np.maximum(z, 0.0) ** 2) / 2)  # an upper bound of the tail
        rejected = benjamini_yekutieli(from_normal, 0.1)
        rates.append((rejected & true).sum() / max(rejected.sum(), 1))
    assert np.mean(rates) < 0.1


def test_what_every_block_says_and_a_few_say_loudest_is_claimed(monkeypatch):
    """Hard manoeuvres show one cause loudly, and all others as much of it, each now with one sign, now with the other.

    Counted as alike, the blocks would leave it out, as chance, though it explains nearly all.
    """
    rng = np.random.default_rng(7)
    J, noise = rng.normal(size=(8, RUNS, BLOCKS * LENGTH, 3)), rng.normal(size=(RUNS, BLOCKS * LENGTH, 3))
    by_block = lambda values: values.repeat(LENGTH, axis=-1).reshape(*values.shape[:-1], RUNS, -1, 1)
    J[0] *= by_block(np.sqrt(1 + 1e4 * 0.6 ** rng.permutation(RUNS * BLOCKS)))
    J[1:] += by_block(rng.choice([-1.0, 1.0], (7, RUNS * BLOCKS))) * J[0]
    sizes, bound = np.array([1.0, 0, 0, 0, 0, 0, 0, 0]), np.full(8, 3.0)
    uneven = lambda theta: noise + np.tensordot(sizes - theta, J, axes=1)
    problem, nominal = toy_problem(monkeypatch, uneven, -bound, bound, RUNS)
    selection = selection_of(problem, nominal, (0, 6))
    model = quadratic_cost(problem, selection.fit, selection.linearisation)
    cause, chance = significance(problem, selection, model, {0: 1.0, 6: 0.0}).values()
    assert cause.by_chance < STRONG < 0.05 < cause.p_value
    assert cause.supported and not cause.exploratory
    assert chance.by_chance > STRONG and not chance.supported and chance.exploratory
