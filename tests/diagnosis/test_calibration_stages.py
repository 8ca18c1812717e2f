"""Stages of a calibration: which stretch decides what, and what is said of parameters that nothing decides."""

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from diagnosis.recorded import problem_of, sedan

from driftjax.core import Control, State
from driftjax.diagnosis import stages
from driftjax.diagnosis.fit import Fit
from driftjax.diagnosis.identifiability import identifiability, stretch_shares
from driftjax.diagnosis.noise import PRIOR
from driftjax.diagnosis.stages import STAGES, marginal_precision, restrict_to_samples, run_stages
from driftjax.diagnosis.stretches import NOWHERE, Stretch, find_stretches, grip_use, tyre_use
from driftjax.vehicle.effect import EFFECTS
from driftjax.vehicle.universal import base_car


def test_every_effect_is_freed_in_one_stage():
    names = list(itertools.chain(*(stage.effects for stage in STAGES)))
    assert len(names) == len(set(names)) and set(names) == set(EFFECTS)


def test_a_parameter_that_trades_off_with_a_later_one_waits_for_it():
    """Stage 1 measures a + b and estimates a alone; stage 2 measures b: a is what both together say."""
    J1, J2, y1, y2 = np.array([[5.0, 5.0]]), np.array([[0.0, 4.0]]), np.array([10.0]), np.array([4.0])
    prior = np.eye(2) / PRIOR**2
    first = np.array([J1[0, 0] * y1[0] / (J1[0, 0] ** 2 + 1 / PRIOR**2), 0.0])  # b stays 0
    known = marginal_precision(prior + J1.T @ J1, np.array([True, False]))
    P = np.linalg.inv(known + np.diag([0.0, 1 / PRIOR**2]))
    assert P[0, 0] > 0.9 * PRIOR**2 and P[0, 1] < -0.9 * PRIOR**2  # nearly unknown, but tied to b
    assert P[1, 1] == pytest.approx(PRIOR**2)  # of which stage 1 says nothing
    H = known + np.diag([0.0, 1 / PRIOR**2]) + J2.T @ J2
    a, b = np.linalg.solve(H, known @ first + J2.T @ y2)
    assert abs(a - 1) < 0.02 and abs(b - 1) < 0.02


@dataclasses.dataclass
class Linear:
    """Three effects, one of each stage, that innovations y - J theta depend on; only those that `use` says count."""

    J: np.ndarray  # (1, T, 1, 3)
    y: np.ndarray  # (1, T, 1)
    use: np.ndarray  # (1, T)
    start: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    precision: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3) / PRIOR**2)
    owner = np.arange(3)
    effects = tuple(SimpleNamespace(name=name) for name in ("drive_gain", "steer_gain", "friction"))
    model, data = SimpleNamespace(base=SimpleNamespace(unit_time=1.0)), SimpleNamespace(dt=1.0)

    @property
    def prior(self) -> np.ndarray:
        return self.precision

    def _replace(self, **fields: Any) -> "Linear":
        return dataclasses.replace(self, **fields)


def _solve(part: Linear, fit: Fit, columns: np.ndarray) -> tuple[Fit, Any]:
    J, theta = (part.J * part.use[..., None, None]).reshape(-1, 3), fit.theta.copy()
    slope = J.T @ (part.y.ravel() - J @ theta) - part.prior @ (theta - part.start)
    theta[columns] += np.linalg.solve((J.T @ J + part.prior)[np.ix_(columns, columns)], slope[columns])
    return Fit(theta, 0.0, part.y), SimpleNamespace(J=J.reshape(part.J.shape))


@pytest.mark.parametrize("kinds", [(1, 2, 3), (3, 3, 3), (1, 3, 3)])
def test_stages_find_the_truth_and_say_where_harder_stretches_disagree(kinds, monkeypatch):
    monkeypatch.setattr(stages, "evaluate_fit", lambda part, theta: Fit(theta, 0.0, part.y))
    monkeypatch.setattr(stages, "restrict_to_samples", lambda problem, counts: problem._replace(use=counts))
    monkeypatch.setattr(stages, "refit_to_convergence", _solve)
    monkeypatch.setattr(stages, "stage_dispersion", lambda *_: 1.0)
    J = 5 * np.random.default_rng(2).standard_normal((1, 60, 1, 3))
    truth, stretch = np.array([1.0, -2.0, 0.5]), np.repeat(kinds, 20)[None]
    J[stretch == Stretch.STRAIGHT, :, 1:] = 0.0  # where steering and friction change nothing
    problem: Any = Linear(J, J @ truth, np.ones((1, 60), bool))
    run = lambda problem, theta: run_stages(problem, stretch, np.arange(3), theta, np.ones(len(Stretch)))
    result = run(problem, np.zeros(3))
    for _ in range(5):
        result = run(problem, result.theta)
    theta = result.theta
    np.testing.assert_allclose(theta, truth, atol=0.02)
    assert np.abs(result.moved).max() < 2
    assert np.isfinite(result.dispersion[Stretch.CORNERING]) == (Stretch.CORNERING in kinds)
    problem.y = problem.y + np.where(stretch == Stretch.LIMIT, J[..., 0, 0], 0.0)[..., None]  # 1 more of drive gain
    assert (abs(run(problem, np.zeros(3)).moved[0]) > 2) == (Stretch.STRAIGHT in kinds)


def test_what_data_tell_of_parameters():
    """The first is measured alone, two by their sum, the fourth hardly, and the last not at all."""
    first = np.diag([400.0, 0.0, 0.0, 0.5, 0.0])
    second = np.zeros((5, 5))
    second[1:3, 1:3] = 900.0
    known = np.stack([first, second])
    precision = known.sum(axis=0) + np.eye(5) / PRIOR**2
    half_width = 1.96 * np.sqrt(np.diag(np.linalg.inv(precision)))
    sharp, one, other, vague, nothing = identifiability(known, np.full(5, 1 / PRIOR**2), precision, half_width)
    assert not (sharp.dead or sharp.flat or sharp.trades_off_with) and sharp.shares[0] > 0.99
    assert one.trades_off_with == (2,) and other.trades_off_with == (1,) and one.flat
    assert vague.flat and not vague.dead and not vague.trades_off_with
    assert nothing.dead and nothing.shares[-1] == 1


def test_shares_make_the_whole_estimate_and_follow_the_data():
    J = np.random.default_rng(1).standard_normal((2, 30, 4)) * np.array([[[1, 1, 1, 1]], [[9, 1, 1, 0]]])
    shares = stretch_shares(np.einsum("sni,snj->sij", J, J), np.full(4, 1 / PRIOR**2))
    np.testing.assert_allclose(shares.sum(axis=0), 1.0)
    assert shares[1, 0] > 0.9 and shares[1, 3] < 0.1 and (shares[-1] < 0.02).all()


def test_axle_forces_are_those_of_the_tyres():
    """Newton's law on the rates of the single track gives back its side forces, over friction times load."""
    car = sedan().build()
    x, u = State(*map(jnp.asarray, (12.0, -0.03, 0.3))), Control(jnp.asarray(0.06), jnp.asarray(0.0))
    rates, base = car(x, u), base_car(car)
    z = np.array([[[*map(float, x), 0.0, 0.0, 0.0]]])
    lateral, slip, Fx = grip_use(base, z, np.array([[list(map(float, rates))]]), np.array([[[0.06, 0.0, 0.0, 0.0]]]))
    Fyf, Fyr = map(float, car.lateral_forces(x, u))
    front = Fyf * np.cos(0.06) / float(base.muf * car.Fzf)
    np.testing.assert_allclose(lateral[0, 0], [front, Fyr / float(base.mur * car.Fzr)], rtol=1e-6)
    np.testing.assert_allclose(tyre_use(base, slip)[0, 0], np.abs([Fyf / float(base.muf * car.Fzf), lateral[0, 0, 1]]))
    assert Fx[0, 0] == 0 and tyre_use(base, np.full((1, 1, 2), 1.5)).max() == 1  # past the peak


def test_drifts_are_at_the_limit_and_later_samples_do_not_change_that_of_earlier_ones():
    problem = problem_of(21, 22, steer_lag=1.0)
    kinds = find_stretches(problem)
    drifts = np.isin(problem.data.run, [0, 1])
    within = kinds != NOWHERE
    assert np.mean(kinds[drifts][within[drifts]] == Stretch.LIMIT) > 0.9
    assert np.mean(kinds[~drifts][within[~drifts]] == Stretch.LIMIT) < 0.9
    y = np.array(problem.data.padded.y)
    y[:, 400:, 2] += 0.5
    later = problem._replace(data=problem.data._replace(padded=problem.data.padded._replace(y=y)))
    np.testing.assert_array_equal(find_stretches(later)[:, :400], kinds[:, :400])


def test_only_what_is_measured_in_a_stretch_counts():
    problem = problem_of(21, 22, steer_lag=1.0)
    counts = find_stretches(problem) == Stretch.LIMIT
    counts[0] = False
    part = restrict_to_samples(problem, counts)
    assert len(part.data.run) == int(counts.any(axis=1).sum()) < len(problem.data.run)
    whitening = np.asarray(part.gains.whitening)
    assert not whitening[~counts[counts.any(axis=1)]].any() and whitening[counts[counts.any(axis=1)]].any()
    assert part.motion is None or part.motion.used.sum() < problem.motion.used.sum()  # type: ignore[union-attr]
