"""Cross-validation of sets: what is left out, fits without it against refits, and what counts as better."""

import numpy as np
import pytest
from diagnosis.toy import BLOCKS, toy_problem

from driftjax.diagnosis.cross_validate import change_of, fits_left_out, left_out_blocks
from driftjax.diagnosis.gain import Errors
from driftjax.diagnosis.noise import PRIOR
from driftjax.diagnosis.refine import refit_to_convergence

K = 3


def linear(runs: int):
    rng = np.random.default_rng(3)
    J, e = rng.normal(size=(K, runs, BLOCKS * 8, 3)), rng.normal(size=(runs, BLOCKS * 8, 3))
    return J, e, lambda theta: J[0] + 0.5 * J[2] + e - np.tensordot(theta, J, axes=1)


def test_fits_without_a_run_are_those_of_the_other_runs(monkeypatch):
    J, _, residuals = linear(5)
    problem, nominal = toy_problem(monkeypatch, residuals, np.full(K, -3.0), np.array([3.0, 3.0, 0.4]), runs=5)
    out, selected = left_out_blocks(problem.data, 2), (0, 2)
    assert out is not None
    fit, at = refit_to_convergence(problem, nominal, problem.columns(selected))
    estimates = fits_left_out(problem, fit, at, selected, out)
    y = residuals(np.zeros(K))
    for run in range(5):
        others = np.arange(5) != run
        A, b = J[0, others].ravel(), (y - 0.4 * J[2])[others].ravel()  # c is at its bound
        np.testing.assert_allclose(estimates[run], [A @ b / (A @ A + 1 / PRIOR**2), 0, 0.4], atol=1e-6)


def test_few_runs_lose_pieces_with_a_buffer_and_a_short_log_none(monkeypatch):
    problem, _ = toy_problem(monkeypatch, linear(6)[2], np.full(K, -3.0), np.full(K, 3.0), runs=6)
    one = problem.data._replace(run=np.zeros(6, int))
    out = left_out_blocks(one, 2)
    assert out is not None
    first, third = np.flatnonzero(out[0]), np.flatnonzero(out[2])
    assert first.tolist() == list(range(BLOCKS + 2))
    assert third.tolist() == list(range(2 * BLOCKS - 2, 3 * BLOCKS + 2))
    two = problem.data._replace(run=np.array([0, 0, 0, 1, 1, 1]))
    out = left_out_blocks(two, 2)
    assert out is not None and np.flatnonzero(out[2]).max() == 3 * BLOCKS - 1  # no buffer in another run
    short, _ = toy_problem(monkeypatch, linear(1)[2], np.full(K, -3.0), np.full(K, 3.0))
    assert left_out_blocks(short.data, 2) is None


def errors_of(rng, scale=(1.0, 1.0, 1.0)) -> tuple[Errors, Errors]:
    """Errors at 40 starts of 8 pieces, and those of a model that errs by `scale` in each channel, up to some noise."""
    old = rng.normal(size=(320, 4, 3))
    new = scale * (old + 0.1 * rng.normal(size=old.shape))
    block, piece = np.arange(320) // 4, np.arange(320) // 40
    return Errors(old**2, (), block, piece), Errors(new**2, (), block, piece)


@pytest.mark.parametrize(
    ("scale", "improves"),
    [((0.9, 0.9, 0.9), True), ((1, 1, 1), False), ((1.1, 1.1, 1.1), False), ((0.8, 0.8, 1.1), False),
     ((0.8, 0.8, 1.0), True)],
)  # fmt: skip
def test_a_model_improves_where_its_error_falls_and_spoils_no_channel(scale, improves):
    change = change_of(*errors_of(np.random.default_rng(4), scale))
    assert change.improves == improves
    np.testing.assert_allclose(np.exp(change.channel), scale, rtol=0.03)
    assert abs(change.total - np.mean(np.log(scale))) < 0.03
    assert 0 < change.total_error < 0.02


def test_an_error_that_chance_makes_smaller_is_not_smaller():
    rng = np.random.default_rng(5)
    old, new = (np.abs(rng.normal(size=(320, 4, 3))) for _ in range(2))
    falls = [
        change_of(Errors(old, (), block := np.arange(320) // 4, block), Errors(old + shift, (), block, block))
        for shift in (0.0, new - old)
    ]
    assert not any(change.improves for change in falls)


def test_starts_that_end_in_a_spin_do_not_decide_alone_but_divergence_does():
    before, after = errors_of(np.random.default_rng(6), (0.9, 0.9, 0.9))
    spun = after.squares.copy()
    spun[5] *= 30.0
    assert change_of(before, after._replace(squares=spun)).improves
    spun[5, 2] = np.inf
    assert not change_of(before, after._replace(squares=spun)).improves
    missing = after.squares.copy()
    missing[300:310] = np.nan
    assert change_of(before, after._replace(squares=missing)).improves
    missing[40:80] = np.nan
    assert not change_of(before, after._replace(squares=missing)).improves
    same = change_of(before, before)
    assert same.total == 0 and not same.improves
