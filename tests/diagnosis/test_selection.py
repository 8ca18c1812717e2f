"""Which effects are named: hidden ones, none, and the statistics of the scores by themselves."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, ORDER, build_problem, hidden, problem_of, recorded, sedan
from scipy.special import ndtr

from driftjax.core import BadInput
from driftjax.diagnosis.evidence import confusable_effects
from driftjax.diagnosis.fit import Fit, Problem, evaluate_fit, information, information_and_score
from driftjax.diagnosis.noise import PRIOR
from driftjax.diagnosis.refine import TOLERANCE
from driftjax.diagnosis.rivals import hypothesis_probabilities
from driftjax.diagnosis.runs import Linearisation, Pieces
from driftjax.diagnosis.score import covariance, normal_scores, overdispersion, partial_out, scores, sums_by_block
from driftjax.diagnosis.select import Selection, search
from driftjax.vehicle.parameters import EffectParameterValue

BLOCKS, LENGTH, SIZE = 24, 8, 5  # of the synthetic data: blocks, samples in each, parameters
FREE, ONE_SIDED = np.full(SIZE, -4.0), np.zeros(SIZE)


def diagnosed(seed, **truth):
    """The search on a recording of a car with the effects `truth`; all cases drive the same manoeuvres."""
    problem = problem_of(31, seed, **truth)
    return problem, search(problem, evaluate_fit(problem, np.zeros(len(ORDER))))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size", "seed"), [("stiffness_front", -0.8, 1), ("steer_offset", 1.3, 2)])
def test_a_hidden_effect_is_named_and_measured(name, size, seed):
    problem, selection = diagnosed(seed, **{name: size})
    assert [ORDER[i] for i in selection.selected] == [name]
    columns = problem.columns(selection.selected)
    deviation = float(np.sqrt(covariance(selection.scores.H, selection.scores.blocks, columns)[0, 0]))
    assert abs(selection.fit.theta[columns[0]] - size) < 6 * deviation
    assert deviation < 0.1  # or the line above says little
    assert selection.fit.cost < selection.nominal.cost - 50
    assert selection.nominal_scores.p_value < 0.05
    H, score = (
        part[columns[0]]
        for part in (np.diag(information(selection.linearisation.J)), information_and_score(selection.linearisation)[1])
    )
    assert (
        score - selection.fit.theta[columns[0]] / PRIOR**2
    ) ** 2 / H < 2 * TOLERANCE  # its own derivatives ask no more


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_nothing_is_named_where_nothing_is_hidden(seed):
    assert diagnosed(seed)[1].selected == ()


def test_a_search_begins_where_the_file_of_the_car_does():
    """What an earlier diagnosis named is neither named again nor lost; what changed since is."""
    known = EffectParameterValue("drive_gain", "p", 0.06 * 1.2)
    vehicle = replace(sedan(), effects=(known,))
    for truth, names in (({"drive_gain": 1.2}, []), ({"drive_gain": 1.2, "steer_lag": 1.0}, ["steer_lag"])):
        problem = build_problem(vehicle, EFFECTS, recorded(hidden(**truth), 21, 22))
        selection = search(problem, evaluate_fit(problem, problem.start))
        assert [ORDER[i] for i in selection.selected] == names
        assert selection.fit.theta[ORDER.index("drive_gain")] == pytest.approx(1.2)
    with pytest.raises(BadInput, match="lacks"):
        build_problem(
            replace(vehicle, effects=(EffectParameterValue("mass", "p", 0.1),)), EFFECTS, recorded(hidden(), 21, 23)
        )


def test_no_more_is_named_than_requested_and_what_is_left_is_reported():
    problem = problem_of(21, 22, steer_lag=1.0, drive_gain=1.2)
    selection = search(problem, evaluate_fit(problem, problem.start), most=1)
    assert len(selection.selected) == 1 and ORDER[selection.selected[0]] in ("drive_gain", "steer_lag")
    assert selection.scores.p_value < 0.05


def made_up(lower=FREE, blocks=BLOCKS) -> Problem:
    """A problem of which only the bookkeeping is used: one piece, `SIZE` effects of one parameter."""
    block = np.repeat(np.arange(blocks), LENGTH)[None]
    data = Pieces(None, np.zeros(1, int), block, blocks, 0.01)  # type: ignore[arg-type]
    model = SimpleNamespace(effects=EFFECTS[:SIZE])
    nothing: Any = None
    known = np.zeros(SIZE), np.arange(SIZE), frozenset[str](), np.ones(SIZE, bool)
    return Problem(model, data, lower, np.full(SIZE, 4.0), *known, nothing, nothing)  # type: ignore[arg-type]


def noise(rng, blocks=BLOCKS) -> Linearisation:
    """Innovations of a true model, and derivatives of which two look alike."""
    shape = (1, blocks * LENGTH, 3)
    J = rng.normal(size=(*shape, SIZE))
    J[..., 1] += 2 * J[..., 0]
    return followed(rng.normal(size=shape), J)


def followed(e, J) -> Linearisation:
    """Innovations and derivatives that come from nowhere."""
    nothing: Any = None
    return Linearisation(e, J, nothing, nothing)


@pytest.mark.parametrize("lower", [FREE, ONE_SIDED], ids=["free", "one-sided"])
@pytest.mark.parametrize("selected", [(), (0,)], ids=["none", "one"])
def test_chance_is_rejected_no_more_often_than_said(lower, selected):
    rng, problem = np.random.default_rng(8), made_up(lower)
    p = np.array([scores(problem, noise(rng), np.zeros(SIZE), selected, seed=i).p_value for i in range(200)])
    assert (p < 0.05).mean() < 0.10
    assert p.min() > 0 and p.max() <= 1
    assert 0.35 < p[p < 0.999].mean() < 0.65  # nor is it shy


def test_dependence_within_blocks_is_not_taken_for_an_effect():
    rng, problem = np.random.default_rng(9), made_up()
    p = []
    for i in range(200):
        at = noise(rng)
        e, J = (np.repeat(np.asarray(a)[:, ::LENGTH], LENGTH, axis=1) for a in (at.e, at.J))
        p.append(scores(problem, followed(e, J), np.zeros(SIZE), (), seed=i).p_value)
    assert np.mean(np.array(p) < 0.05) < 0.10


def test_an_effect_in_the_data_has_a_significant_score_and_its_true_gain():
    rng, problem = np.random.default_rng(10), made_up()
    at, size = noise(rng), 0.4
    e = np.asarray(at.e) + size * np.asarray(at.J)[..., 3]
    result = scores(problem, at._replace(e=e), np.zeros(SIZE), (), seed=0)
    assert result.p_value < 0.005 and np.argmax(np.abs(result.T)) == 3 == np.argmax(result.gain)
    explained = np.sum(e**2) - np.sum((e - size * np.asarray(at.J)[..., 3]) ** 2)
    assert result.gain[3] == pytest.approx(explained, rel=0.2)


def test_several_parameters_of_an_effect_are_tested_together():
    """Four that act in six blocks each, so that no |T| can pass the root of six; together they do."""
    problem = made_up()._replace(owner=np.array([0, 0, 0, 0, 1]))
    rng, J, shape = np.random.default_rng(13), np.zeros((1, BLOCKS * LENGTH, 3, SIZE)), (1, BLOCKS * LENGTH, 3)
    for k in range(4):
        J[:, k * 6 * LENGTH : (k + 1) * 6 * LENGTH, :, k] = 1.0
    by_chance, results = [], []
    for seed in range(100):
        e = rng.normal(size=shape)
        J[..., 4] = rng.normal(size=shape)
        by_chance.append(scores(problem, followed(e, J), np.zeros(SIZE), (), seed).p_value)
        results.append(scores(problem, followed(e + J @ [0.8, -0.8, 0.8, -0.8, 0.0], J), np.zeros(SIZE), (), seed))
    assert np.mean(np.array(by_chance) < 0.05) < 0.12  # p < 1e-3 at a rate of 5 %
    assert max(np.abs(one.T[:4]).max() for one in results) < np.sqrt(6) + 1e-9
    assert np.median([one.joint[0] for one in results]) > np.sqrt(6) + 1
    assert np.median([one.p_value for one in results]) < 0.01


@pytest.mark.parametrize("spread", [0.0, 2.0])
def test_scores_are_as_rare_as_normal_numbers_however_unlike_the_blocks_are(spread):
    """By random signs themselves; scores that are studentised have no tail where blocks are unlike."""
    rng = np.random.default_rng(15)
    blocks = rng.choice([-1.0, 1.0], (60, 3)) * np.exp(spread * rng.normal(size=(60, 3)))
    U = rng.choice([-1.0, 1.0], (200_000, 60)) @ blocks
    z = normal_scores(blocks, U)
    for level in (2.0, 3.0):
        by_chance = np.mean(np.abs(z) > level, axis=0)
        assert (by_chance > 0.7 * 2 * ndtr(-level)).all() and (by_chance < 3.5 * 2 * ndtr(-level)).all()
    np.testing.assert_array_equal(np.argsort(z, axis=0), np.argsort(U, axis=0))
    if not spread:
        np.testing.assert_allclose(z, U / np.sqrt(60), rtol=0.08)


def test_an_effect_that_all_blocks_agree_on_is_rare_though_two_say_most():
    rng, problem, found = np.random.default_rng(16), made_up(), []
    for seed in range(20):
        J = rng.normal(size=(1, BLOCKS * LENGTH, 3, SIZE))
        J[:, : 2 * LENGTH, :, 3] *= 8.0
        noise = rng.normal(size=J.shape[:3])
        there, nothing = (
            scores(problem, followed(e, J), np.zeros(SIZE), (), seed) for e in (noise + 0.3 * J[..., 3], noise)
        )
        columns = np.array([3])
        found.append((abs(there.T[3]), there.own_p_value(3, columns), nothing.own_p_value(3, columns)))
    T, rare, by_chance = np.array(found).T
    assert np.median(T) < 2.2 and np.median(rare) < 1e-4 and (by_chance < 0.05).sum() <= 3


def test_signs_that_an_effect_cannot_have_are_not_tested():
    rng, problem = np.random.default_rng(11), made_up(ONE_SIDED)
    at = noise(rng)
    e = np.asarray(at.e) - 0.6 * np.asarray(at.J)[..., 3]
    result = scores(problem, at._replace(e=e), np.zeros(SIZE), (), seed=0)
    assert result.T[3] == 0 == result.gain[3]
    free = scores(made_up(), at._replace(e=e), np.zeros(SIZE), (), seed=0)
    assert free.T[3] < -4


def test_members_have_no_score_and_take_theirs_out_of_others():
    rng, problem = np.random.default_rng(12), made_up()
    at, selected = noise(rng), (0, 3)
    columns, J = np.array(selected), np.asarray(at.J)
    flat = J.reshape(-1, SIZE)
    P = partial_out(flat.T @ flat, columns)
    effective = (flat * np.asarray(at.e).reshape(-1, 1)) @ P
    np.testing.assert_allclose(effective[:, columns], 0, atol=1e-10)
    left = flat[:, 1] - flat[:, columns] @ np.linalg.lstsq(flat[:, columns], flat[:, 1])[0]
    np.testing.assert_allclose((flat @ P)[:, 1], left, atol=1e-9)
    one = scores(problem, at, np.zeros(SIZE), selected, seed=0)
    assert not one.T[columns].any() and not one.gain[columns].any()
    moved = np.asarray(at.e) + J[..., columns] @ np.array([0.7, -0.3])  # what members can explain
    other = scores(problem, at._replace(e=moved), np.zeros(SIZE), selected, seed=0)
    np.testing.assert_allclose(other.gain, one.gain, rtol=1e-6, atol=1e-9)


def test_covariance_of_independent_data_is_the_inverse_information():
    rng, problem = np.random.default_rng(13), made_up(blocks=300)
    at, columns = noise(rng, 300), np.array([0, 1, 2])
    J = np.asarray(at.J).reshape(-1, SIZE)[:, columns]
    expected = np.linalg.inv(J.T @ J)
    estimated = covariance(*sums_by_block(problem, at.e, at.J), columns)
    np.testing.assert_allclose(np.diag(estimated), np.diag(expected), rtol=0.25)
    correlation = lambda c: c / np.sqrt(np.outer(np.diag(c), np.diag(c)))
    np.testing.assert_allclose(correlation(estimated), correlation(expected), atol=1e-9)


def test_covariance_grows_where_samples_of_a_block_say_the_same():
    rng, problem, columns = np.random.default_rng(14), made_up(blocks=300), np.array([0, 1])
    at = noise(rng, 300)
    e, J = (np.repeat(np.asarray(a)[:, ::LENGTH], LENGTH, axis=1) for a in (at.e, at.J))
    flat = J.reshape(-1, SIZE)[:, columns]
    estimated = covariance(*sums_by_block(problem, e, J), columns)
    np.testing.assert_allclose(np.diag(estimated), LENGTH * np.diag(np.linalg.inv(flat.T @ flat)), rtol=0.3)


def repeated(at: Linearisation) -> Linearisation:
    """The same data where all samples of a block say what its first one does."""
    return followed(*(np.repeat(np.asarray(a)[:, ::LENGTH], LENGTH, axis=1) for a in (at.e, at.J)))


def rivals(at: Linearisation, problem: Problem) -> tuple[np.ndarray, float]:
    """Costs of the effects 0 and 1 where effect 0 acts a little, and the overdispersion at the fit of effect 0."""
    J = np.asarray(at.J)
    e = np.asarray(at.e) + 0.04 * J[..., 0]
    left = lambda k: e - J[..., k] * (np.sum(J[..., k] * e) / np.sum(J[..., k] ** 2))
    return np.array([np.sum(left(k) ** 2) for k in (0, 1)]), overdispersion(
        *sums_by_block(problem, left(0), J), np.array([0])
    )


def test_probabilities_are_no_surer_for_samples_that_say_the_same():
    rng, problem = np.random.default_rng(15), made_up(blocks=300)
    stated = {}
    for name, change in (("independent", lambda at: at), ("repeated", repeated)):
        cases = [rivals(change(noise(rng, 300)), problem) for _ in range(60)]
        excess = np.array([excess for _, excess in cases])
        assert excess.min() >= 1
        assert excess.mean() == pytest.approx(1.0 if name == "independent" else LENGTH, rel=0.15)
        stated[name] = np.array(
            [[hypothesis_probabilities(costs, np.ones(2), by)[0] for by in (1.0, c)] for costs, c in cases]
        )
    assert np.abs(np.diff(stated["independent"])).max() < 0.06
    sure = ((stated["repeated"] < 0.01) | (stated["repeated"] > 0.99)).mean(axis=0)
    assert sure[0] > 0.15 and sure[1] < 0.05  # wrongly sure, or not


def test_the_p_value_of_an_effect_is_its_own():
    rng, problem = np.random.default_rng(16), made_up()
    at = noise(rng)
    result = scores(problem, at._replace(e=np.asarray(at.e) + 0.4 * np.asarray(at.J)[..., 3]), np.zeros(SIZE), (), 0)
    assert result.p_value_of(3, np.array([3])) == result.p_value < 0.005
    assert min(result.p_value_of(i, np.array([i])) for i in (0, 2, 4)) > 0.05


def test_effects_of_several_parameters_can_be_taken_for_others():
    """Effect 0 is the sum of both parameters of effect 1, which look little like it one by one."""
    problem = made_up()._replace(owner=np.array([0, 1, 1, 2, 3]))
    problem = problem._replace(model=SimpleNamespace(effects=EFFECTS[:4]))  # type: ignore[arg-type]
    rng, nothing = np.random.default_rng(17), None
    J = rng.normal(size=(1, BLOCKS * LENGTH, 3, SIZE))
    J[..., 0] = J[..., 1] + J[..., 2] + 0.1 * J[..., 0]
    at = followed(rng.normal(size=J.shape[:-1]), J)
    for member, theta, expected in ((0, [1, 0, 0, 0, 0], (1,)), (1, [0, 1, 1, 0, 0], (0,)), (1, [0, 1, -1, 0, 0], ())):
        left = scores(problem, at, np.array(theta, float), (member,), 0)
        fit: Any = Fit(np.array(theta, float), 0.0, nothing)  # type: ignore[arg-type]
        selection = Selection((member,), fit, at, left, problem, fit, left)
        assert confusable_effects(problem, selection, member) == expected


def test_a_direction_without_information_does_not_count_in_the_overdispersion():
    """As of an effect whose samples are all lost, or of two with the same signature."""
    rng = np.random.default_rng(0)
    blocks, root = rng.standard_normal((200, 2)) * [3.0, 2.0], np.array([[1.0, 0.0], [0.0, 1.0], [0.5, -0.5]])
    H = 200 * np.eye(2)
    regular = overdispersion(H, blocks, np.arange(2))
    assert regular == pytest.approx(np.mean((blocks**2).sum(axis=0) / 200) * 200 / 198)
    silent = overdispersion(np.pad(H, (0, 1)), np.pad(blocks, ((0, 0), (0, 1))), np.arange(3))
    mixed = overdispersion(root @ H @ root.T, blocks @ root.T, np.arange(3))
    assert [silent, mixed] == pytest.approx([regular] * 2)
