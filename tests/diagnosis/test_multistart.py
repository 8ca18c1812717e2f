"""A strong effect in data without disturbances, which throws the observer of the nominal car off."""

from collections import namedtuple
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, ORDER, build_problem, hidden, recorded, sedan

from driftjax.core import BadInput
from driftjax.diagnosis import multistart
from driftjax.diagnosis.fit import Fit, evaluate_fit, initial_noise, with_noise
from driftjax.diagnosis.multistart import (
    LEAST_DISTURBANCE,
    LOST_MISFIT,
    disturbance_ratio,
    misfit,
    nominal_fit,
    search_from_far,
    search_multistart,
    with_nominal_noise,
)
from driftjax.diagnosis.noise_model import Noise
from driftjax.diagnosis.refine import refit_to_convergence
from driftjax.diagnosis.score import scores
from driftjax.diagnosis.select import Selection


@pytest.mark.slow
def test_what_is_found_round_about_is_what_was_hidden():
    truth = hidden(friction_rear=1.4, load_transfer_long=1.4)
    problem = build_problem(sedan(), EFFECTS, recorded(truth, 5, 6, disturbed=0.0))
    repeated, selection = search_from_far(problem, 0)
    assert sorted(ORDER[i] for i in selection.selected) == ["friction_rear", "load_transfer_long"]
    np.testing.assert_allclose(selection.fit.theta, truth, atol=0.05)
    assert misfit(repeated, selection.fit) < 1.1 and selection.nominal_scores.p_value < 0.05
    assert misfit(selection.base, selection.nominal) < 1.5  # that observer follows the car whatever acts on it
    assert repeated.noise.disturbance.max() < 0.1 * selection.base.noise.disturbance.max()


@pytest.mark.slow
def test_a_lost_observer_is_no_end():
    """Gains that trust the nominal car entirely, and sensors twice as good as they are."""
    truth = hidden(friction_rear=1.4)
    problem = build_problem(sedan(), EFFECTS, recorded(truth, 5, 7, disturbed=0.0))
    noise = initial_noise(problem.data)
    small = noise._replace(sigma=noise.sigma / 2, disturbance=1e-4 * noise.disturbance, slow=1e-4 * noise.slow)
    trusting = with_noise(problem, 0 * truth, small)
    assert misfit(trusting, nominal_fit(trusting)) > LOST_MISFIT
    repeated, selection = search_multistart(trusting)
    assert [ORDER[i] for i in selection.selected] == ["friction_rear"] and repeated is not trusting
    assert selection.fit.cost < evaluate_fit(repeated, truth).cost + 1.0


def test_too_much_noise_shows_at_the_fit_and_the_search_goes_on_with_the_right_one():
    truth = hidden(friction_rear=1.4)
    problem = build_problem(sedan(), EFFECTS, recorded(truth, 5, 7))
    noise = problem.noise
    loud = with_noise(problem, problem.start, noise._replace(disturbance=4 * noise.disturbance))
    member = (ORDER.index("friction_rear"),)
    ratios = []
    for one in (problem, loud):
        fit, at = refit_to_convergence(one, evaluate_fit(one, truth), one.columns(member))
        remaining = scores(one, at, fit.theta, member, 0)
        ratios.append(disturbance_ratio(one, Selection(member, fit, at, remaining, one, fit, remaining)))
    assert ratios[0].min() > 0.7 and ratios[0].max() < 1.3 and ratios[1].min() < LEAST_DISTURBANCE
    repeated, selection = search_multistart(loud)
    assert [ORDER[i] for i in selection.selected] == ["friction_rear"] and selection.base is loud
    assert repeated.noise.disturbance[2] == pytest.approx(noise.disturbance[2], rel=0.2)


@pytest.mark.parametrize(("skip", "kept", "share"), [(5, 30.0, 0.5), (5, 1e3, 0.0), (5, 0.0, 1.0), (0, 0.0, 0.0)])
def test_where_an_inferred_sideslip_is_lost_the_noise_is_taken_closer_to_the_assumed_one(
    monkeypatch, skip, kept, share
):
    """`kept`: largest disturbance with which the observer keeps the car. A measured sideslip holds it by itself."""
    assumed = Noise(np.full(3, 0.1), np.array([1.0, 0.5, 1.0]), 0.3, np.full(3, 0.03), 0.3)
    estimated = assumed._replace(disturbance=np.array([5.0, 1e-4, 400.0]), correlation=5.0)
    monkeypatch.setattr(multistart, "initial_noise", lambda data: assumed)
    monkeypatch.setattr(multistart, "with_estimated_noise", lambda p, *_: p._replace(noise=estimated))
    monkeypatch.setattr(multistart, "with_noise", lambda p, theta, noise: p._replace(noise=noise))
    lost = lambda p: SimpleNamespace(cost=np.inf if p.noise.disturbance.max() > kept else 1.0)
    monkeypatch.setattr(multistart, "nominal_fit", lost)
    Problem = namedtuple("Problem", "start active data noise")
    loose: Any = with_nominal_noise(Problem(np.zeros(1), np.ones(1, bool), SimpleNamespace(skip=skip), assumed))  # type: ignore[arg-type]
    expected = assumed.as_vector() ** share * estimated.as_vector() ** (1 - share)
    np.testing.assert_allclose(loose.noise.as_vector(), expected)


@pytest.mark.parametrize("cost", [np.inf, np.nan])
def test_a_search_whose_own_noise_loses_the_car_keeps_what_it_had(monkeypatch, cost):
    lost = SimpleNamespace(cost=cost)
    monkeypatch.setattr(multistart, "with_estimated_noise", lambda problem, *_: problem)
    monkeypatch.setattr(multistart, "evaluate_fit", lambda *_: lost)
    monkeypatch.setattr(multistart, "refit_to_convergence", lambda *_: (lost, None))
    problem: Any = SimpleNamespace(active=None, columns=lambda selected: np.zeros(0, int))
    rough: Any = SimpleNamespace(fit=SimpleNamespace(theta=np.zeros(1)), selected=())
    assert multistart.search_with_own_noise(problem, rough, 0, 4, lambda text: None) == (problem, rough)


def test_data_that_no_car_can_have_made_are_refused():
    run = recorded(hidden(), 5, 8)[0]
    broken = (run.__class__(run.name, run.t, 1e200 * run.V, run.beta, run.r, run.delta, run.Fxr, run.dt, {}),)
    with pytest.raises(BadInput, match="units"):
        search_multistart(build_problem(sedan(), EFFECTS, broken))


@pytest.mark.parametrize(
    ("true", "saved", "named", "left", "begins"),
    [
        (0.16, 0.3, (), 100.0, 0.15),
        (0.21, 0.3, (), 100.0, 0.2),
        (0.16, 0.04, (), 100.0, None),
        (0.16, 0.3, (1,), 100.0, None),
        (0.16, 0.3, (0, 2), 80.0, 0.15),
        (0.16, 0.3, (0, 2), 60.0, None),
    ],
    ids=["the middle one", "the latest", "none saves enough", "named already", "better than a lag", "worse than a lag"],
)
def test_a_search_begins_at_the_delay_that_saves_most_by_itself(monkeypatch, true, saved, named, left, begins):
    """On a made-up cost with its least value at a delay `true` [s], of a car whose unit of time is 0.2 s.

    The effects named before leave the cost `left`.
    """
    effects = [SimpleNamespace(name=name) for name in ("friction", "steer_delay", "steer_lag")]
    model = SimpleNamespace(effects=effects, base=SimpleNamespace(unit_time=0.2), scale=np.array([0.1, 0.02, 0.02]))
    problem = SimpleNamespace(
        model=model, effects=effects, start=np.zeros(3), active=np.ones(3, bool), owner=np.arange(3),
        columns=lambda which: np.array(which, int),
    )  # fmt: skip
    cost = lambda theta: 100.0 * (1 - saved * np.exp(-(((theta[1] * 0.02 - true) / 0.05) ** 2)))
    fit = lambda problem, theta: Fit(theta, cost(theta), np.zeros(1))
    monkeypatch.setattr(multistart, "evaluate_fits", lambda problem, thetas: [fit(problem, one) for one in thetas])
    monkeypatch.setattr(multistart, "refit_to_convergence", lambda problem, fit, columns: (fit, None))
    searched = []

    def search(problem, fit, seed, selected, most, report):
        searched.append((fit.theta[1] * 0.02, selected))
        return SimpleNamespace(_replace=lambda **changes: SimpleNamespace(**changes))

    monkeypatch.setattr(multistart, "search", search)
    start, scores = fit(problem, problem.start), object()
    fitted = Fit(np.array([0.5, 0.0, 1.0]), left, np.zeros(1))
    close: Any = SimpleNamespace(nominal=start, nominal_scores=scores, selected=named, fit=fitted)
    selection: Any = multistart.search_from_late(problem, close, 0, 8, print)  # pyright: ignore[reportArgumentType]
    assert searched == ([] if begins is None else [(pytest.approx(begins), (1,))])
    assert selection is None if begins is None else (selection.nominal, selection.nominal_scores) == (start, scores)


@pytest.mark.parametrize(
    ("true", "saved", "named", "begins", "selects"),
    [
        ((0.011, 0.011, 0.0), 0.3, (0,), (0.01, 0.01, 0.0), (1,)),
        ((0.0, 0.0, 0.038), 0.3, (0,), (0.0, 0.0, 0.04), (1,)),
        ((0.018, 0.02, 0.022), 0.3, (1,), (0.02, 0.02, 0.02), (1,)),
        ((0.02, 0.02, 0.02), 0.04, (0,), None, ()),
        ((0.02, 0.02, 0.02), 0.3, (), None, ()),
        ((0.02, 0.02, 0.02), 0.4, (), (0.02, 0.02, 0.02), (1,)),
        ((0.011, 0.011, 0.0), 0.4, (2,), (0.01, 0.01, 0.0), (1, 2)),
    ],
    ids=[
        "speed and sideslip", "yaw rate", "all, named already", "none saves enough",
        "no delay named, and no more saved than its parameters cost", "nothing named", "beside another effect",
    ],
)  # fmt: skip
def test_the_search_begins_at_late_sensors_too(monkeypatch, true, saved, named, begins, selects):
    """On a made-up cost with its least value at the delays `true` [s], of a car whose unit of time is 0.2 s."""
    effects = [SimpleNamespace(name=name) for name in ("steer_delay", "channel_delay", "speed_scale")]
    scale = np.array([0.02, 0.016, 0.016, 0.016, 0.03])
    model = SimpleNamespace(effects=effects, base=SimpleNamespace(unit_time=0.2), scale=scale)
    owner = np.array([0, 1, 1, 1, 2])
    problem: Any = SimpleNamespace(
        model=model, effects=effects, start=np.zeros(5), active=np.ones(5, bool), owner=owner,
        columns=lambda which: np.flatnonzero(np.isin(owner, which)),
    )  # fmt: skip
    off = lambda theta: np.sum(((theta * scale)[1:4] - true) ** 2) / 0.01**2
    fit = lambda problem, theta: Fit(theta, 100.0 * (1 - saved * np.exp(-off(theta))), np.zeros(1))
    monkeypatch.setattr(multistart, "evaluate_fits", lambda problem, thetas: [fit(problem, one) for one in thetas])
    monkeypatch.setattr(multistart, "refit_to_convergence", lambda problem, fit, columns: (fit, None))
    searched = []

    def search(problem, fit, seed, selected, most, report):
        searched.append((tuple((fit.theta * scale)[1:4]), selected))
        return SimpleNamespace(_replace=lambda **changes: SimpleNamespace(**changes))

    monkeypatch.setattr(multistart, "search", search)
    start = fit(problem, problem.start)
    close: Any = SimpleNamespace(nominal=start, nominal_scores=object(), selected=named, fit=start)
    multistart.search_from_late_sensors(problem, close, 0, 8, print)
    assert searched == ([] if begins is None else [(pytest.approx(begins), selects)])


@pytest.mark.parametrize(
    ("true", "named", "begins", "selects"),
    [
        (1.1, (0, 2), 1.0, (1, 2)),
        (1.1, (2,), 1.0, (1, 2)),
        (1.1, (1, 2), None, ()),
        (0.0, (2,), None, ()),
    ],
    ids=["in the place of a limit of traction", "beside another effect", "named already", "none better"],
)
def test_the_search_begins_at_a_power_limit_too(monkeypatch, true, named, begins, selects):
    """On a made-up cost that a limit near `true` typical sizes lowers by more than one of traction does."""
    effects = [SimpleNamespace(name=name) for name in ("traction_limit", "power_limit", "mass")]
    problem: Any = SimpleNamespace(
        effects=effects, start=np.zeros(3), active=np.ones(3, bool), owner=np.arange(3),
        columns=lambda which: np.flatnonzero(np.isin(np.arange(3), which)),
    )  # fmt: skip
    cost = lambda theta: 100.0 + 30 * (theta[1] - true) ** 2 - 15 * theta[0] - 50 * theta[2]
    fit = lambda problem, theta: Fit(theta, cost(theta), np.zeros(1))
    monkeypatch.setattr(multistart, "evaluate_fits", lambda problem, thetas: [fit(problem, one) for one in thetas])
    monkeypatch.setattr(multistart, "refit_to_convergence", lambda problem, fit, columns: (fit, None))
    searched = []

    def search(problem, fit, seed, selected, most, report):
        searched.append((fit.theta[1], fit.theta[2], selected))
        return SimpleNamespace(_replace=lambda **changes: SimpleNamespace(**changes))

    monkeypatch.setattr(multistart, "search", search)
    theta = np.isin(np.arange(3), [i for i in named if i != 1]) * 1.0 + np.array([0.0, true * (1 in named), 0.0])
    close: Any = SimpleNamespace(nominal=fit(problem, problem.start), nominal_scores=object(), selected=named)
    close.fit = fit(problem, theta)
    multistart.search_from_power_limit(problem, close, 0, 8, print)
    assert searched == ([] if begins is None else [(begins, 1.0, selects)])
