"""An observer of long memory: how long it is, what its cost counts, and what it names where single steps mislead."""

import functools

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, ORDER, build_problem, hidden, recorded, sedan
from diagnosis.test_prediction_fit import HIDDEN, smooth_runs

from driftjax.diagnosis.diagnose import diagnose
from driftjax.diagnosis.fit import Problem, evaluate_fit, information, linearise, with_noise
from driftjax.diagnosis.gain import DECISIVE, horizon_steps, open_loop_errors, ratios
from driftjax.diagnosis.held_out import DiagnoseConfig
from driftjax.diagnosis.memory import memory_of, with_long_memory
from driftjax.diagnosis.predictive_naming import Naming, name_by_predictions, name_by_steps, name_by_the_better
from driftjax.logs import Log
from driftjax.studies.hidden_effects.against_truth import costs_against

OTHERS = tuple(name for name in ORDER if name not in {*HIDDEN, "yaw_inertia", "drive_gain"})


def names_of(naming: Naming) -> set[str]:
    return {ORDER[i] for i in naming.selection.selected}


@functools.cache
def smooth_problem() -> Problem:
    return build_problem(sedan(), EFFECTS, smooth_runs(3), OTHERS)


@functools.cache
def by_steps() -> Naming:
    return name_by_steps(smooth_problem(), 0, 8)


@functools.cache
def by_predictions() -> Naming:
    naming, own = name_by_the_better(smooth_problem(), 0, 8, 0.1)
    assert naming.by_predictions and own is not None
    return naming


def test_the_memory_is_as_long_as_shares_of_the_error_are_measured_ahead():
    problem = smooth_problem()
    long, horizon = with_long_memory(problem), horizon_steps(problem)[DECISIVE]
    assert long is not None and memory_of(problem) < 0.1 * horizon
    assert memory_of(long) == pytest.approx(horizon, rel=0.05)
    assert with_long_memory(long) is None, "it remembers as long already"


def test_the_long_memory_does_not_depend_on_how_long_disturbances_last():
    """Those that last would be estimated, and take in what the car gets wrong; predictions carry none ahead."""
    problem = smooth_problem()

    def gains(correlation):
        share = np.sqrt(problem.noise.correlation / correlation)  # of the same power
        noise = problem.noise._replace(correlation=correlation, disturbance=share * problem.noise.disturbance)
        long = with_long_memory(with_noise(problem, problem.start, noise))
        assert long is not None
        valid = np.asarray(long.data.padded.valid) > 0
        return np.asarray(long.gains.L)[..., :3, :][valid.all(axis=-1)]

    short, lasting = gains(0.1), gains(5.0)
    np.testing.assert_allclose(lasting, short, atol=0.05 * np.abs(short).max())


def test_what_no_effect_explains_costs_one_for_each_memory():
    long = with_long_memory(smooth_problem())
    assert long is not None
    nominal = evaluate_fit(long, long.start)
    e, J = np.asarray(nominal.e)[..., :3], np.asarray(linearise(long, nominal).J)[..., :3, long.active]
    left = np.sum((e - J @ np.linalg.solve(information(J), np.einsum("ptij,pti->j", J, e))) ** 2)
    measured = np.sum(np.asarray(long.data.padded.valid))
    assert left == pytest.approx(measured / memory_of(long), rel=0.05)
    louder = with_noise(long, long.start, long.noise._replace(**{
        name: 2 * getattr(long.noise, name) for name in ("sigma", "disturbance", "slow")
    }))  # fmt: skip
    assert memory_of(louder) == pytest.approx(memory_of(long))
    assert np.sum(np.asarray(evaluate_fit(louder, long.start).e)[..., :3] ** 2) == pytest.approx(np.sum(e**2) / 4)


def test_of_a_right_car_both_name_the_same():
    runs = recorded(hidden(steer_lag=1.0, drive_gain=1.2), 21, 22)
    problem = build_problem(sedan(), EFFECTS, runs, OTHERS)
    steps, own = name_by_the_better(problem, 0, 8, 0.1)
    assert not steps.by_predictions and own is not None, "they leave no errors"
    ahead = name_by_predictions(steps, 0, 8)
    assert ahead is not None and names_of(steps) == names_of(ahead) == {"steer_lag", "drive_gain"}
    columns = problem.columns(steps.selection.selected)
    np.testing.assert_allclose(ahead.selection.fit.theta[columns], steps.selection.fit.theta[columns], atol=0.25)


def test_single_steps_name_what_a_smooth_sensor_imitates_and_predictions_do_not():
    """Of what is hidden nobody knows the filter of the sideslip; a false yaw inertia stands for it."""
    assert names_of(by_steps()) > set(HIDDEN)
    assert names_of(by_predictions()) == set(HIDDEN)
    friction = ORDER.index("friction_rear")
    assert by_predictions().selection.fit.theta[friction] == pytest.approx(hidden(**HIDDEN)[friction], abs=0.15)
    other = build_problem(sedan(), EFFECTS, smooth_runs(5), OTHERS)
    other = with_noise(other, other.start, by_steps().problem.noise)
    nominal = open_loop_errors(other, other.start)
    steps, ahead = (
        ratios(nominal, open_loop_errors(other, one.selection.fit.theta))[DECISIVE, 0]
        for one in (by_steps(), by_predictions())
    )
    assert ahead < 0.95 * steps, "on runs that neither has seen"


def test_predictions_start_from_the_observer_of_short_memory():
    naming = by_predictions()
    assert naming.searched is not naming.problem and naming.found.base is naming.searched
    assert memory_of(naming.problem) < memory_of(naming.searched) / 10
    base, nominal = naming.selection.base, naming.selection.nominal
    assert base is not naming.searched and nominal.cost == evaluate_fit(base, base.start).cost


def test_the_verdict_says_what_named_the_effects():
    result = diagnose(sedan(), Log(smooth_runs(3)), DiagnoseConfig(gp=False, without=OTHERS), effects=EFFECTS)
    content, gain = result.content(), result.gain
    assert gain is not None and gain.by_predictions and content["named_by"] == "predictions"
    assert "the effects are those that an observer with a memory of 1.1 s names" in result.sentence
    assert {cause.effect for cause in result.causes} == set(HIDDEN)
    assert not any(cause.exploratory for cause in result.causes)
    assert result.evidence is not None
    costs = costs_against(result.evidence, hidden(**HIDDEN), result.evidence.naming.found.selected)
    assert costs["truth"] == pytest.approx(costs["named"], abs=0.2), "both by the same observer"
    evidence, scale = result.evidence, np.asarray(result.evidence.problem.model.scale)
    theta = evidence.sizes.theta if evidence.sizes else evidence.selection.fit.theta
    assert {one.effect: one.value for one in result.extended.effects} == pytest.approx(
        {name: float((scale * theta)[ORDER.index(name)]) for name in HIDDEN}
    )
