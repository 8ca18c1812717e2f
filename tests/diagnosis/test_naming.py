"""No effect is named in whose place another one is more probable."""

import dataclasses

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, ORDER, hidden, problem_of, recorded, sedan

import driftjax.diagnosis.refine as refining
from driftjax.diagnosis.beam import quadratic_cost
from driftjax.diagnosis.diagnose import diagnose
from driftjax.diagnosis.evidence import FIRM, SMALL_SHARE, SURE_PROBABILITY, find_causes, named_effects
from driftjax.diagnosis.fit import evaluate_fit, information_and_score
from driftjax.diagnosis.held_out import DiagnoseConfig, measure_gain
from driftjax.diagnosis.naming import leave_out_unconfirmed, prefer_probable
from driftjax.diagnosis.refine import TOLERANCE, refine, refit_to_convergence
from driftjax.diagnosis.rivals import effect_probabilities
from driftjax.diagnosis.score import scores
from driftjax.diagnosis.select import Selection, Significance
from driftjax.diagnosis.verdict import Verdict, describe_cause
from driftjax.logs import Log


def selection_of(problem, names) -> Selection:
    """The selection of these effects, fitted, whatever a search would choose."""
    selected, start = tuple(sorted(ORDER.index(name) for name in names)), evaluate_fit(problem, problem.start)
    fit, at = refit_to_convergence(problem, start, problem.columns(selected))
    tested = scores(problem, at, fit.theta, selected, 0)
    return Selection(selected, fit, at, tested, problem, start, tested)


@pytest.mark.parametrize(
    ("truth", "named"),
    [
        pytest.param({"steer_lag": 1.0}, ["yaw_inertia"], marks=pytest.mark.slow),
        ({"steer_lag": 1.0, "drive_gain": 1.2}, ["drive_gain", "yaw_inertia"]),
        pytest.param({"steer_lag": 1.0, "drive_gain": 1.2}, ["stiffness_front", "aero_drag"], marks=pytest.mark.slow),
    ],
    ids=lambda names: "-".join(names),
)
def test_a_rival_that_is_more_probable_is_named_instead(truth, named):
    problem = problem_of(21, 22, **truth)
    wrong = selection_of(problem, named)
    better = prefer_probable(problem, wrong)
    assert {ORDER[i] for i in better.selected} == set(truth)
    assert better.fit.cost < wrong.fit.cost
    for cause in find_causes(problem, better):
        assert all(cause.probability >= p for p in cause.rivals.values())
        assert cause.theta[0] == pytest.approx(truth[ORDER[cause.effect]], abs=0.2)


def test_from_a_set_far_off_it_ends_where_no_rival_is_more_probable():
    """One replacement at a time need not lead to the truth; that is for the search."""
    problem = problem_of(21, 22, steer_lag=1.0, drive_gain=1.2)
    wrong = selection_of(problem, ["drive_gain", "relaxation_length"])
    better = prefer_probable(problem, wrong)
    assert len(better.selected) == 2 and better.fit.cost < wrong.fit.cost
    for cause in find_causes(problem, better):
        assert all(cause.probability >= p for p in cause.rivals.values())


def test_what_is_most_probable_stays():
    problem = problem_of(21, 22, steer_lag=1.0)
    right = selection_of(problem, ["steer_lag"])
    assert prefer_probable(problem, right).fit is right.fit


@pytest.mark.parametrize(("upper", "ends"), [(0.5, True), (3.0, False)])
def test_a_cause_at_its_bound_is_marked(upper, ends):
    problem = problem_of(21, 22, steer_lag=1.0)
    bounds = problem.upper.copy()
    bounds[ORDER.index("steer_lag")] = upper
    problem = problem._replace(upper=bounds)
    (cause,) = find_causes(problem, selection_of(problem, ["steer_lag"]))
    (named,) = named_effects(problem, [cause])
    assert named.parameters["tau"]["at_bound"] is ends
    assert ("at its bound" in describe_cause(problem, cause)) is ends
    assert named.exploratory is ends, "it stands for something else"
    assert describe_cause(problem, cause).startswith("Exploratory: ") is ends


def test_a_cause_of_little_error_that_a_rival_may_explain_as_well_is_exploratory():
    """However significant it is; one that explains much, or has no rival, is claimed."""
    problem = problem_of(21, 22, steer_lag=1.0)
    both = selection_of(problem, ["steer_lag", "drive_gain"])
    both = both._replace(significance={i: Significance(0.01, False, True, 0.01) for i in both.selected})
    large, small = find_causes(problem, both)
    assert ORDER[large.effect] == "steer_lag" and large.probability > SURE_PROBABILITY and not large.exploratory
    assert small.error_share.share < SMALL_SHARE and small.probability < SURE_PROBABILITY and small.exploratory
    sure, much = small._replace(probability=1.0), small._replace(error_share=large.error_share)
    assert not sure.small_and_unsure and not much.small_and_unsure


def test_beside_a_parameter_at_its_bound_the_others_are_fitted_to_the_end(monkeypatch):
    """What the data ask for beyond the bound promises nothing: no further step is tried."""
    problem = problem_of(21, 22, steer_lag=1.0, drive_gain=1.2)
    lag, gain = problem.columns((ORDER.index("steer_lag"),))[0], problem.columns((ORDER.index("drive_gain"),))[0]
    problem = problem._replace(upper=np.where(np.arange(len(ORDER)) == lag, 0.5, problem.upper))
    fit, at = refit_to_convergence(problem, evaluate_fit(problem, problem.start), np.array([lag, gain]))
    H, score = information_and_score(at)
    slope = score - problem.prior @ (fit.theta - problem.start)
    assert fit.theta[lag] == 0.5 and slope[lag] > 0, "the data ask for more"
    assert slope[gain] ** 2 / H[gain, gain] < TOLERANCE
    monkeypatch.delattr(refining, "evaluate_fits")
    assert refine(problem, fit, np.array([lag, gain]), at) is fit


def test_where_nothing_is_named_there_is_nothing_to_replace():
    problem = problem_of(21, 22)
    assert prefer_probable(problem, nothing := selection_of(problem, [])) is nothing


def test_a_rival_wins_only_by_a_refitted_cost(monkeypatch):
    """A promise of the quadratic model that refitting does not keep counts for nothing."""
    problem = problem_of(21, 22, steer_lag=1.0)
    right = selection_of(problem, ["steer_lag"])
    model = quadratic_cost(problem, right.fit, right.linearisation)
    monkeypatch.setattr("driftjax.diagnosis.rivals.rival_gains", lambda model, rest: np.full(len(ORDER), 1e9))
    share = effect_probabilities(problem, right, model, right.selected[0])
    assert share.argmax() == right.selected[0]


def test_effects_that_a_part_of_the_runs_does_not_show_are_left_out():
    problem = problem_of(21, 22, steer_lag=1.0)
    lag, gain = ORDER.index("steer_lag"), ORDER.index("drive_gain")
    both = selection_of(problem, ["steer_lag", "drive_gain"])
    with_p_values = lambda **of: both._replace(
        significance={i: Significance(of[ORDER[i]], False, True, of[ORDER[i]]) for i in both.selected}
    )
    weak = with_p_values(steer_lag=0.02, drive_gain=0.02)
    assert leave_out_unconfirmed(problem, weak, np.nan, ("steer_lag", "drive_gain", "mass"), 0) == (weak, ())
    assert leave_out_unconfirmed(problem, weak, 0.2, (), 0) == (weak, ()), "predictions confirm them"
    less, names = leave_out_unconfirmed(problem, weak, np.nan, ("steer_lag",), 0)
    assert names == ("drive_gain",) and less.selected == (lag,)
    alone = selection_of(problem, ["steer_lag"])
    np.testing.assert_allclose(less.fit.theta, alone.fit.theta, atol=0.02)
    strong, names = leave_out_unconfirmed(problem, with_p_values(steer_lag=5e-4, drive_gain=0.02), np.nan, (), 0)
    assert names == ("drive_gain",) and strong.selected == (lag,)
    contradicted, names = leave_out_unconfirmed(problem, weak, np.nan, ("drive_gain",), 0)
    assert names == tuple(ORDER[i] for i in both.selected), "without the lag a rival is more probable than the gain"
    assert contradicted.selected == () and {lag, gain} == set(both.selected)
    np.testing.assert_array_equal(contradicted.fit.theta, problem.start)


def test_beside_an_inferred_force_only_what_predictions_confirm_is_named_and_only_what_is_firm_is_claimed(monkeypatch):
    """Errors of the force are the same in all runs: neither a small p-value nor a part of the runs tells them apart."""
    problem = problem_of(21, 22, steer_lag=1.0, drive_gain=1.2)
    both = selection_of(problem, ["steer_lag", "drive_gain"])
    both = both._replace(significance={i: Significance(1e-4, False, True, 1e-4) for i in both.selected})
    inferred = problem._replace(data=problem.data._replace(skip=1, force_known=False))
    again = ("steer_lag", "drive_gain")
    assert leave_out_unconfirmed(problem, both, np.nan, again, 0) == (both, ())
    assert leave_out_unconfirmed(inferred, both, 0.2, (), 0) == (both, ()), "predictions confirm them"
    nothing, names = leave_out_unconfirmed(inferred, both, np.nan, again, 0)
    assert nothing.selected == () and set(names) == {*again}
    causes = find_causes(problem, both)
    assert not any(cause.exploratory for cause in causes) and causes == find_causes(inferred, both)
    firmness = [abs(cause.theta[0]) / cause.half_width[0] for cause in causes]
    assert min(firmness) > FIRM, "the lag and the gain are firm by themselves"
    monkeypatch.setattr("driftjax.diagnosis.evidence.FIRM", np.mean(firmness))
    assert [cause.exploratory for cause in find_causes(inferred, both)] == [one < np.mean(firmness) for one in firmness]
    assert not any(cause.exploratory for cause in find_causes(problem, both))


def test_a_name_that_no_prediction_and_no_other_runs_confirm_is_left_out_of_the_verdict(monkeypatch):
    """The gain is measured, and then changed to that of a log in which little or nothing is wrong."""

    def measured(problem, names, config):
        gain = measure_gain(problem, names, config)
        assert gain is not None and gain.named == ("steer_lag",) and gain.skills["extended"].value > 0.5
        doubtful = gain.skills["extended"]._replace(value=np.nan, remaining_ci95=(0.0, 0.05))
        return dataclasses.replace(gain, named=(), skills=dict.fromkeys(gain.skills, doubtful))

    monkeypatch.setattr("driftjax.diagnosis.diagnose.measure_gain", measured)
    monkeypatch.setattr("driftjax.diagnosis.naming.STRONG", 0.0)  # the lag is found beyond doubt
    log, options = Log(recorded(hidden(steer_lag=1.0), 5, 6)), DiagnoseConfig(gp=False, without=("friction_rear",))
    result = diagnose(sedan(), log, options, effects=EFFECTS)
    assert result.verdict is Verdict.NOTHING and result.causes == () and result.extended.effects == ()
    assert result.content()["unconfirmed"] == ["steer_lag"] and "Left out is steer_lag" in result.sentence
