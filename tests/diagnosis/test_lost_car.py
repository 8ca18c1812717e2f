"""Where the observer loses the car, its derivatives grow without bound: they do not count from there on."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import driftjax as dj
from driftjax.core import BadInput
from driftjax.diagnosis import fit
from driftjax.diagnosis.log_limits import Unidentifiable
from driftjax.diagnosis.runs import Linearisation
from driftjax.diagnosis.verdict import Judgement, Verdict, without_lost_time

P, T, K = 5, 40, 3


def derivatives() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(P, T, 3, K))


def spun() -> np.ndarray:
    """Derivatives of which those of piece 2 grow tenfold with each sample from sample 20 on."""
    J = derivatives()
    J[2, 20:] *= 10.0 ** np.arange(1, 21)[:, None, None]
    return J


def test_from_where_derivatives_run_away_nothing_counts():
    lost = fit.lost_samples(spun())
    assert not lost[[0, 1, 3, 4]].any() and not lost[2, :20].any()
    (first,) = np.flatnonzero(np.diff(lost[2].astype(int))) + 1
    assert 21 <= first <= 25 and lost[2, first:].all()
    broken = derivatives()
    broken[1, 7, 0, 0] = np.nan
    assert fit.lost_samples(broken)[1].tolist() == [False] * 7 + [True] * (T - 7)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e5])
def test_derivatives_of_any_even_size_count(size):
    """Of logs with little noise they are large; a piece that says ten times as much as others is none that is lost."""
    J = size * derivatives()
    J[3] *= 10
    assert not fit.lost_samples(J).any()


def test_information_is_that_of_the_other_samples(monkeypatch):
    J = spun()
    e = np.zeros((P, T, 3))
    monkeypatch.setattr(fit, "differentiate", lambda *args: Linearisation(e, J, None, None))  # type: ignore[arg-type]
    data = SimpleNamespace(skip=5)  # the sideslip is inferred
    problem: Any = SimpleNamespace(model=None, data=data, gains=None, active=None, motion=None)
    at = fit.linearise(problem, fit.Fit(np.zeros(K), 0.0, e))
    assert at.lost is not None
    expected = fit.information(np.where(at.lost[..., None, None], 0.0, J))
    np.testing.assert_allclose(fit.information(at.J), expected)
    assert np.trace(fit.information(J)) > 1e20 * np.trace(expected)
    data.skip = 0  # it is measured, and holds the observer
    linearisation = fit.linearise(problem, fit.Fit(np.zeros(K), 0.0, e))
    assert linearisation.lost is None and linearisation.J is J


def test_a_car_that_is_lost_most_of_the_time_is_reported():
    valid = np.ones((P, T, 3))
    problem: Any = SimpleNamespace(data=SimpleNamespace(padded=SimpleNamespace(valid=valid), dt=0.1))
    lost = np.zeros((P, T), bool)
    at: Any = Linearisation(None, None, None, None, lost)  # type: ignore[arg-type]
    lost[0, 30:] = True
    assert fit.time_lost(problem, at) == pytest.approx(1.0)
    assert fit.time_lost(problem, at._replace(lost=None)) == 0.0
    lost[:] = True
    with pytest.raises(BadInput, match="loses the car in 100 % of the time.*steering delay"):
        fit.time_lost(problem, at)


def test_the_sentence_says_how_long_the_car_was_lost():
    assert (
        "The observer loses the car in 12.5 s of the log, which do not count."
        in Unidentifiable((), {}, {}, (), 12.5).sentence
    )
    assert Unidentifiable((), {}, {}, ()).sentence == ""


def run_at(V: np.ndarray) -> dj.Run:
    none = np.full_like(V, np.nan)
    return dj.Run("a", 0.0625 * np.arange(len(V)), V, none, 0 * V, 0 * V, none, 0.0625)


def test_steps_are_small_enough_for_the_slowest_stretch():
    """A stiff tyre at a few slow samples diverges by itself; a single wrong sample asks for nothing."""
    car, slow = dj.load_vehicle("f1tenth"), np.full(100, 1.3)
    slow[40:44] = 0.5
    steps = fit.stable_substeps(car, (run_at(np.full(100, 1.3)), run_at(slow)))
    assert (
        steps
        == fit.stable_substeps(car, (run_at(np.full(100, 0.5)),))
        > fit.stable_substeps(car, (run_at(np.full(100, 1.3)),))
    )
    wrong = np.full(100, 1.3)
    wrong[[7, 50]] = 0.0, np.nan
    assert fit.stable_substeps(car, (run_at(wrong),)) == fit.stable_substeps(car, (run_at(np.full(100, 1.3)),))
    rate = car.mu * car.B * car.C * 9.81 / 0.5 * car.m * car.a * car.b / car.Iz
    assert 0.0625 * rate / steps < 2.78  # what the Runge-Kutta method bears


@pytest.mark.parametrize(
    ("verdict", "lost_s", "expected"),
    [
        ("NAMED", 6.1, "UNKNOWN"),
        ("NAMED", 5.9, "NAMED"),
        ("NOTHING", 30.0, "UNKNOWN"),
        ("DATA_INSUFFICIENT", 30.0, "DATA_INSUFFICIENT"),
    ],
)
def test_time_in_which_the_car_is_lost_is_not_explained(verdict, lost_s, expected):
    judgement = Judgement(Verdict(verdict), "The front tyres have another friction.")
    after = without_lost_time(judgement, lost_s, 60.0, 0.1)
    assert after.verdict == expected and judgement.sentence in after.sentence
    assert ("loses the car for" in after.sentence) == (after.verdict != verdict)
