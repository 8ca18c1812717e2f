"""A cause has nearly the same size in every run: a size that differs is distinguished from one that is only inexact."""

import numpy as np
from diagnosis.toy import BLOCKS, LENGTH, toy_problem

from driftjax.diagnosis.evidence import TOLERANCE, homogeneity_p_value, invariance
from driftjax.diagnosis.refine import refit_to_convergence
from driftjax.diagnosis.score import scores
from driftjax.diagnosis.select import Selection

SIZE, RUNS, CASES = 0.5, 8, 400


def p_values(spread: float, known: float, tolerance: float, excess: float = 1.0) -> np.ndarray:
    """For sizes that vary by `spread` between runs, and scores that vary by `excess` times their information."""
    rng = np.random.default_rng(0)
    size = SIZE + spread * rng.standard_normal((CASES, RUNS))
    noise = np.sqrt(excess / known) * rng.standard_normal((CASES, RUNS))
    score = known * (size + noise - SIZE)
    return np.array([homogeneity_p_value(row, np.full(RUNS, known), tolerance, excess) for row in score])


def test_equal_sizes_are_refused_at_the_level_of_the_test():
    for excess in (1.0, 4.0):
        assert abs(np.mean(p_values(0.0, 100.0, 0.0, excess) < 0.05) - 0.05) < 0.03


def test_a_size_that_varies_as_much_as_tolerated_is_refused_at_that_level_however_much_data_there_are():
    for known in (1e4, 1e8):
        assert np.mean(p_values(TOLERANCE * SIZE, known, TOLERANCE * SIZE) < 0.05) < 0.08
    assert np.mean(p_values(TOLERANCE * SIZE, 1e4, 0.0) < 0.05) > 0.95  # which a test for equality would not bear


def test_a_size_that_is_another_in_each_run_is_refused():
    assert np.mean(p_values(2 * SIZE, 1e4, TOLERANCE * SIZE) < 1e-3) > 0.95


def test_runs_that_say_nothing_do_not_count():
    score, known = np.array([0.1, -0.1, 0.0, 1e-6]), np.array([100.0, 100.0, 100.0, 1e-9])
    assert homogeneity_p_value(score, known, 0.0) == homogeneity_p_value(score[:3], known[:3], 0.0)


def test_a_parameter_that_the_log_says_nothing_of_leaves_the_others_as_they_are(monkeypatch):
    """The delay of a sensor that the log lacks is a parameter of a named effect, too."""
    noise, *signals = np.random.default_rng(3).standard_normal((4, 4, BLOCKS * LENGTH, 3))

    def of_members(*members: int) -> dict[int, float]:
        residuals = lambda theta: noise - sum(signals[i] * (theta[i] - 1) for i in (0, 2))
        toy, start = toy_problem(monkeypatch, residuals, np.full(3, -3.0), np.full(3, 3.0), runs=4)
        fit, at = refit_to_convergence(toy, start, np.array(members))
        tested = scores(toy, at, fit.theta, members, 0)
        return invariance(toy, Selection(members, fit, at, tested, toy, start, tested))

    known, both = of_members(0, 2), of_members(0, 1, 2)
    assert both == {**known, 1: 1.0} and 0 < min(known.values()) < 1
