"""Hypotheses, pieces and predictions side by side: each is what it is alone."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diagnosis.recorded import ORDER, catalogue, hidden, problem_of, recorded, sedan, truth
from diagnosis.toy import BLOCKS, LENGTH, toy_problem

from driftjax.core import State
from driftjax.diagnosis.beam import quadratic_cost
from driftjax.diagnosis.fit import evaluate_fit, evaluate_fits, information, linearise
from driftjax.diagnosis.gain import predict, predict_path
from driftjax.diagnosis.refine import refine, refine_together, refit_to_convergence, secant_derivatives
from driftjax.diagnosis.rivals import replacement_costs, rival_gains
from driftjax.diagnosis.runs import observer_gains, pieces, run_observer, run_observers
from driftjax.diagnosis.score import scores
from driftjax.diagnosis.select import Selection
from driftjax.sim.rollout import move

ROUNDING = 1e-9  # relative


@pytest.fixture(scope="module")
def problem():
    return problem_of(21, 22, steer_lag=1.0, drive_gain=1.2)


def with_values(problem, **values):
    theta = problem.start.copy()
    for name, value in values.items():
        theta[problem.columns((ORDER.index(name),))] = value
    return theta


def test_a_hypothesis_that_diverges_leaves_the_others_as_they_are(problem):
    thetas = [with_values(problem, steer_lag=lag) for lag in (0.0, 0.5, 1.0)]
    lost = np.full(len(problem.start), np.nan)
    together = evaluate_fits(problem, [thetas[0], lost, *thetas[1:]])
    assert together[1].cost == np.inf
    for theta, fit in zip(thetas, (together[0], *together[2:]), strict=True):
        alone = evaluate_fit(problem, theta)
        assert fit.cost == pytest.approx(alone.cost, rel=ROUNDING)
        np.testing.assert_allclose(fit.e, alone.e, atol=1e-7)


def test_a_piece_is_followed_alike_whatever_is_beside_it():
    run = recorded(hidden(), 1, 2)[0]
    cut = lambda n: replace(run, **{k: getattr(run, k)[:n] for k in ("t", "V", "beta", "r", "delta", "Fxr")}, extra={})
    data, start = pieces(sedan(), (cut(120), cut(240), cut(200))), np.zeros(len(ORDER))
    gains = observer_gains(catalogue(), data, start, truth().as_vector())
    few = run_observer(catalogue(), data, start, gains)
    piece = np.resize(np.arange(3), 21)
    many = run_observers(catalogue(), data, np.tile(start, (21, 1)), piece, gains)
    for name in ("e", "z", "u", "d", "y"):
        for i, n in enumerate((120, 240, 200)):
            expected = np.broadcast_to(np.asarray(getattr(few, name))[i, :n], (7, n, *getattr(few, name).shape[2:]))
            np.testing.assert_allclose(np.asarray(getattr(many, name))[piece == i, :n], expected, atol=1e-7)
    assert not np.asarray(many.e)[piece == 0, 120:].any(), "the padding has no innovations"


def test_sets_refined_in_one_batch_are_those_refined_alone(problem):
    start = evaluate_fit(problem, problem.start)
    near = linearise(problem, start)
    names = ("steer_lag",), ("drive_gain", "yaw_inertia"), ("steer_lag", "drive_gain"), ()
    columns = [problem.columns(tuple(ORDER.index(name) for name in each)) for each in names]
    together = refine_together(problem, [start] * len(columns), columns, near)
    for fit, which in zip(together, columns, strict=True):
        alone = refine(problem, start, which, near)
        assert fit.cost == pytest.approx(alone.cost, rel=ROUNDING)
        np.testing.assert_allclose(fit.theta, alone.theta, atol=1e-6)
    assert together[2].cost < min(together[0].cost, together[1].cost)
    assert together[3] is start, "nothing to refine"


def test_corrected_derivatives_explain_the_step_and_change_nothing_across_it(problem):
    """The secant equation, and the least change: what is orthogonal to the step in the metric keeps its derivative."""
    columns = problem.columns((ORDER.index("steer_lag"), ORDER.index("drive_gain")))
    before, after = (
        evaluate_fit(problem, with_values(problem, steer_lag=x, drive_gain=y)) for x, y in ((0, 0), (1, 1))
    )
    at = linearise(problem, before)
    J = np.asarray(at.J)[..., columns]
    corrected, step = secant_derivatives(problem, J, columns, before, after), (after.theta - before.theta)[columns]
    assert corrected is not None
    np.testing.assert_allclose(corrected @ step, before.e - after.e, atol=1e-9)
    W = information(J) + problem.prior[np.ix_(columns, columns)]
    across = np.array([-(W @ step)[1], (W @ step)[0]])
    np.testing.assert_allclose(corrected @ across, J @ across, atol=1e-6 * np.abs(J @ across).max())
    own = np.asarray(linearise(problem, after).J)[..., columns]
    error = lambda J: np.linalg.norm((J - own) @ step)
    assert error(corrected) < error(J), "nearer to those of the new fit along the step"
    lost = np.ones(before.e.shape[:2], bool)
    np.testing.assert_array_equal(secant_derivatives(problem, J, columns, before, after, lost), J)
    assert secant_derivatives(problem, -2.5 * J, columns, before, after) is None, "they predict the opposite"


def test_a_set_is_refined_to_the_minimum_with_the_derivatives_of_another_fit(problem, monkeypatch):
    """Corrections stand for derivatives of its own; the minimum is the one that these give."""
    start = evaluate_fit(problem, problem.start)
    columns = problem.columns((ORDER.index("steer_lag"), ORDER.index("drive_gain")))
    near = linearise(problem, start)
    best = refit_to_convergence(problem, start, columns)[0]
    monkeypatch.setattr("driftjax.diagnosis.refine.linearise", lambda *_: pytest.fail("no derivatives of its own"))
    fit = refine(problem, start, columns, near, num=12)
    assert best.cost <= fit.cost < best.cost + 0.1 < start.cost - 100


def test_rivals_of_all_members_cost_what_they_cost_member_by_member(problem):
    selected = tuple(sorted(ORDER.index(name) for name in ("steer_lag", "drive_gain")))
    start = evaluate_fit(problem, problem.start)
    fit, at = refit_to_convergence(problem, start, problem.columns(selected))
    tested = scores(problem, at, fit.theta, selected, 0)
    selection = Selection(selected, fit, at, tested, problem, start, tested)
    model = quadratic_cost(problem, fit, at)
    together = replacement_costs(problem, selection, model, selected)
    for member in selected:
        alone = replacement_costs(problem, selection, model, (member,))[member]
        np.testing.assert_allclose(together[member], alone, rtol=1e-6)
        assert together[member].argmin() == member
        assert np.isinf(together[member][[i for i in selected if i != member]]).all()


def test_a_rival_is_refitted_where_the_model_puts_it_a_little_too_high(monkeypatch):
    """At b = 1 the second effect explains all that the first does; its derivatives at b = 0 say 15 less of 100."""
    rng = np.random.default_rng(7)
    noise, signal, other = rng.standard_normal((3, 1, BLOCKS * LENGTH, 3))
    signal *= 10 / np.linalg.norm(signal)
    other -= signal * np.sum(other * signal) / np.sum(signal**2)
    other *= 10 * np.sqrt(0.15 / 0.85) / np.linalg.norm(other)
    residuals = lambda theta: noise + signal - theta[0] * signal - theta[1] * signal - theta[1] * (1 - theta[1]) * other
    toy, start = toy_problem(monkeypatch, residuals, np.full(2, -3.0), np.full(2, 3.0))
    fit, at = refit_to_convergence(toy, start, np.array([0]))
    tested = scores(toy, at, fit.theta, (0,), 0)
    selection = Selection((0,), fit, at, tested, toy, start, tested)
    model = quadratic_cost(toy, fit, at)
    predicted = model.cost - rival_gains(model, ())[1] - fit.cost
    assert predicted > 8, "by this it would not be credible"
    costs = replacement_costs(toy, selection, model, (0,))[0]
    assert costs[1] - fit.cost < 2


def test_predictions_are_roll_outs_from_the_estimates(problem):
    data, model, theta = problem.data, problem.model, with_values(problem, steer_lag=1.0)
    path = run_observer(model, data, theta, problem.gains)
    starts, num = np.array([60, 200, data.size - 2]), 5
    predicted = predict_path(problem, theta, path, starts, num)
    car = model.with_parameters(jnp.asarray(theta))
    step = jax.jit(lambda z, u, place: move(car, z, u, place, jnp.asarray(data.dt), State(*jnp.zeros(3))).z)
    for piece, start in ((0, 60), (3, 200)):
        z = jnp.asarray(path.z[piece, start])
        for k in range(num):
            place = jax.tree.map(lambda a, row=(piece, start + k): jnp.asarray(np.asarray(a)[row]), data.padded.place)
            z = step(z, jnp.asarray(path.u[piece, start + k]), place)
            at = predicted[piece, list(starts).index(start), k, 0]
            np.testing.assert_allclose(at, z[:3], rtol=1e-7, atol=1e-9)
    assert not predicted[:, 2].any(), "the runs are over there"


def test_one_size_for_each_piece_predicts_as_one_size_for_all(problem):
    theta = with_values(problem, drive_gain=1.0)
    each = np.tile(problem.start, (len(problem.data.run), 1))
    each[2] = theta
    mixed, same, bare = (predict(problem, one).error for one in (each, theta, problem.start))
    np.testing.assert_allclose(mixed[2], same[2], atol=1e-7)
    np.testing.assert_allclose(np.delete(mixed, 2, 0), np.delete(bare, 2, 0), atol=1e-7)
    assert np.nanmax(np.abs(mixed[2] - bare[2])) > 0.01
