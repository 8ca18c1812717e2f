"""What the catalogue lacks: generic terms find the variable and the size; and what to drive next when names compete."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, ORDER, build_problem, hidden, recorded, sedan

from driftjax.diagnosis import propose as next_manoeuvre
from driftjax.diagnosis.beam import quadratic_cost
from driftjax.diagnosis.evidence import Cause, own_scores
from driftjax.diagnosis.fit import Problem, evaluate_fit, linearise, with_noise
from driftjax.diagnosis.gain import Share
from driftjax.diagnosis.prediction_fit import PredictionFit
from driftjax.diagnosis.propose import in_full_catalogue, propose_manoeuvre
from driftjax.diagnosis.refine import refit_to_convergence
from driftjax.diagnosis.residual import disturbance_forces
from driftjax.diagnosis.rivals import effect_probabilities
from driftjax.diagnosis.score import scores
from driftjax.diagnosis.select import Selection
from driftjax.diagnosis.shapley import ErrorShare
from driftjax.diagnosis.unexplained_errors import best_term, find_unexplained, generic_terms, rates_of_forces
from driftjax.diagnosis.verdict import Explained, Judgement, Verdict, decide_verdict, describe_answer, explained_by
from driftjax.logs import Run
from driftjax.manoeuvres.library import MANOEUVRES, NoDrift
from driftjax.vehicle.effect import EFFECTS as CATALOGUE
from driftjax.vehicle.single_track import G

ALL = ErrorShare(1.0, (1.0, 1.0))
FREE = np.zeros(1, bool)  # not at its bound
MUCH_LEFT = Explained(0.3, (0.2, 0.4), 0.6, (0.5, 0.7), 1.0, True)


@functools.cache
def nominal_only(name: str, size: float) -> tuple[Problem, Selection]:
    """Runs with an effect that the catalogue lacks, and a search that has named nothing."""
    theta = hidden(**{name: size}) if size else hidden()
    problem = build_problem(sedan(), EFFECTS, recorded(theta, 1, 2), without=(name,))
    fit = evaluate_fit(problem, np.zeros(len(ORDER)))
    at = linearise(problem, fit)
    remaining = scores(problem, at, fit.theta, (), 0)
    return problem, Selection((), fit, at, remaining, problem, fit, remaining)


def test_a_missing_drive_gain_is_reported_as_a_force_that_varies_with_the_drive():
    problem, selection = nominal_only("drive_gain", 2.5)
    remaining = find_unexplained(problem, selection, 0)
    gain = 2.5 * EFFECTS[ORDER.index("drive_gain")].parameters[0].typical
    assert (
        remaining.significant and "Fxr" in list(remaining.variables)[:4]
    )  # in a drift, sideslip and drive go together
    assert (remaining.term.channel, remaining.term.function, remaining.term.unit) == ("V", "Fxr/(mg)", "m/s^2")
    assert remaining.term.value == pytest.approx(gain * G, rel=0.25) and 0 < remaining.term.half_width < 0.3 * gain * G
    decision = decide_verdict(problem, selection, [], remaining, 36.0, MUCH_LEFT, 0.1)
    assert decision.verdict == Verdict.UNKNOWN and "Fxr/(mg) in the rate of V" in decision.sentence


def test_without_a_name_nothing_is_explained_whatever_a_part_of_the_runs_names():
    """The drive gain is not in the catalogue; a car that other runs than these named errs little on them."""
    problem, selection = nominal_only("drive_gain", 2.5)
    remaining = find_unexplained(problem, selection, 0)
    shares = {
        "nominal": Share(0.0, (0.0, 0.0), 0.4, (0.3, 0.5)),
        "extended": Share(1.0, (0.7, 1.0), 0.0, (0.0, 0.2)),
    }
    for named, verdict in ((False, Verdict.UNKNOWN), (True, Verdict.NOTHING)):
        explained = explained_by(shares, named, 1.0, held_out=True)
        assert explained and (explained.share, explained.remaining) == ((1.0, 0.0) if named else (0.0, 0.4))
        assert decide_verdict(problem, selection, [], remaining, 36.0, explained, 0.1).verdict is verdict
    assert explained_by({}, True, 1.0, held_out=True) is None


def test_a_missing_bias_of_the_gyro_is_reported_as_an_error_of_the_sensor():
    problem, selection = nominal_only("gyro_bias", 2.0)
    remaining = find_unexplained(problem, selection, 0)
    bias = 2.0 * float(problem.model.scale[ORDER.index("gyro_bias")])
    assert remaining.significant and next(iter(remaining.variables)) == "1" == next(iter(remaining.nominal_variables))
    assert remaining.term[:3] == ("r", "sensor", "1") and remaining.term.unit == "rad/s"
    assert remaining.term.value == pytest.approx(bias, rel=0.15)
    assert (
        "in what is measured as r" in decide_verdict(problem, selection, [], remaining, 36.0, MUCH_LEFT, 0.1).sentence
    )


def test_effects_that_one_force_outdoes_only_imitate_it():
    problem, selection = nominal_only("drive_gain", 2.5)
    useless = tuple(ORDER.index(name) for name in ("yaw_inertia", "steer_offset"))
    one, two = (find_unexplained(problem, selection._replace(selected=useless[:num]), 0) for num in (1, 2))
    assert one.simpler is None and two.simpler is not None
    assert two.simpler[:3] == ("V", "rate", "Fxr/(mg)")
    named = [Cause(i, np.ones(1), np.ones(1), 1.0, {}, (), 1.0, 0.001, 1.0, ALL, FREE) for i in useless]
    decision = decide_verdict(problem, selection, named, two._replace(p_value=1.0), 36.0, MUCH_LEFT, 0.1)
    assert (
        decision.verdict == Verdict.UNKNOWN
        and "yaw_inertia, steer_offset together explain no more" in decision.sentence
    )


@pytest.mark.parametrize(
    ("low", "high", "left", "verdict"),
    [
        (0.7, 0.89, 0.2, Verdict.UNKNOWN),
        (0.7, 0.91, 0.2, Verdict.NAMED),
        (0.4, 0.95, 0.2, Verdict.UNKNOWN),
        (0.4, 0.89, 0.09, Verdict.NAMED),
        (np.nan, np.nan, 0.0, Verdict.NAMED),
    ],
    ids=["too little", "perhaps enough", "perhaps nothing", "a small error", "in doubt that there is any"],
)
def test_the_size_of_what_is_left_decides_whether_it_is_unknown(low, high, left, verdict):
    """What remains is significant in each case."""
    problem, selection = nominal_only("drive_gain", 2.5)
    remaining = find_unexplained(problem, selection, 0)._replace(share=0.05)  # of what would be named
    assert remaining.significant
    cause = Cause(ORDER.index("friction_rear"), np.ones(1), np.ones(1), 1.0, {}, (), 1.0, 0.001, 1.0, ALL, FREE)
    explained = Explained((low + high) / 2, (low, high), left + 0.05, (left, left + 0.1), 1.0, True)
    decision = decide_verdict(problem, selection, [cause], remaining, 36.0, explained, 0.1)
    assert decision.verdict == verdict and next(iter(remaining.variables)) in decision.sentence
    assert ("of the excess error" in decision.sentence) == np.isfinite(high)
    differing = cause._replace(invariance=1e-6)
    if verdict == Verdict.NAMED:
        decision = decide_verdict(problem, selection, [differing], remaining, 36.0, explained, 0.1)
        assert decision.verdict == Verdict.SET and "differs from run to run" in decision.sentence
        beside = [cause, differing._replace(effect=ORDER.index("drive_gain"), exploratory=True)]
        decision = decide_verdict(problem, selection, beside, remaining, 36.0, explained, 0.1)
        assert decision.verdict == Verdict.NAMED and "size of drive_gain differs from run to run" in decision.sentence
        small = decide_verdict(problem, selection, [], remaining, 36.0, explained, 0.1)
        assert small.verdict == Verdict.NOTHING and "too small" in small.sentence
        assumed = problem._replace(data=problem.data._replace(force_known=False))
        without_force = decide_verdict(assumed, selection, [cause], remaining, 36.0, explained, 0.1)
        assert without_force.verdict == Verdict.NAMED  # an estimated force is judged by the same sizes
        inferred, doubtful = problem._replace(data=assumed.data._replace(skip=1)), cause._replace(exploratory=True)
        assert decide_verdict(inferred, selection, [cause], remaining, 36.0, explained, 0.1).verdict == Verdict.NAMED
        alone = decide_verdict(inferred, selection, [doubtful], remaining, 36.0, explained, 0.1)
        assert alone.verdict == Verdict.UNKNOWN and "errors of the drive force" in alone.sentence
        assert decide_verdict(assumed, selection, [doubtful], remaining, 36.0, explained, 0.1).verdict == Verdict.NAMED
        simpler = remaining._replace(simpler=remaining.term)
        for log, doubt in ((assumed, Verdict.SET), (inferred, Verdict.UNKNOWN)):
            decision = decide_verdict(log, selection, [cause], simpler, 36.0, explained, 0.1)
            assert decision.verdict == doubt and ("one cause that is missing" in decision.sentence) == (log is inferred)


def test_the_sentence_gives_the_sizes_of_the_retuned_car_where_that_is_the_answer():
    problem, selection = nominal_only("drive_gain", 2.5)
    effect = ORDER.index("friction_rear")
    theta, columns = np.where(np.arange(len(ORDER)) == effect, -2.0, 0.0), np.array([effect])
    retuned = PredictionFit(theta, columns, np.eye(len(ORDER)), np.zeros((9, len(ORDER))), 1.0)
    words = functools.partial(describe_answer, problem=problem)
    share = Share(0.97, (0.9, 0.99), 0.1, (0.0, 0.2))
    said = words("retuned", retuned=retuned, shares={"retuned": share})
    typical = EFFECTS[effect].parameters[0].typical
    assert f"(friction_rear {-2 * typical:+.2g} ± {retuned.spread.half_width[0] * typical:.1g})" in said
    assert said.endswith("it is the answer, which explains 97 % [90, 99] of the excess error. ")
    assert words("retuned", retuned=retuned, shares={"retuned": share._replace(value=np.nan)}).endswith("answer. ")
    started = problem._replace(start=np.where(np.arange(len(ORDER)) == effect, 1.0, 0.0))
    assert "before" not in said and f", before {typical:+.2g})" in words(
        "retuned", problem=started, retuned=retuned, shares={}
    )
    assert "nominal car predicts better" in words("nominal", retuned=None, shares={})
    assert words("extended", retuned=None, shares={}) == ""


def test_what_remains_beside_a_name_keeps_it_from_being_certain_by_its_share():
    problem, selection = nominal_only("drive_gain", 2.5)
    remaining = find_unexplained(problem, selection, 0)
    assert remaining.share == 1  # nothing is named
    cause = Cause(ORDER.index("friction_rear"), np.ones(1), np.ones(1), 1.0, {}, (), 1.0, 0.001, 1.0, ALL, FREE)
    explained = Explained(0.97, (0.95, 1.0), 0.05, (0.03, 0.07), 1.0, True)
    verdict = lambda left: decide_verdict(problem, selection, [cause], left, 36.0, explained, 0.1)
    assert verdict(remaining._replace(share=0.09)).verdict == Verdict.NAMED
    doubt = verdict(remaining._replace(share=0.11))
    assert doubt.verdict == Verdict.SET and "in the rate of V explains 11 % of the misfit" in doubt.sentence
    assert verdict(remaining._replace(share=0.11, p_value=1.0)).verdict == Verdict.NAMED


def test_less_grip_of_the_rear_that_the_catalogue_lacks_is_a_lateral_force_of_the_rear_axle():
    """Its sign is that of less force in the direction against the slip."""
    problem, selection = nominal_only("friction_rear", -1.0)
    remaining = find_unexplained(problem, selection, 0)
    assert remaining.significant and remaining.term[:2] == ("Fyr", "force") and remaining.term.unit == "N"
    assert (
        "in the lateral force Fyr" in decide_verdict(problem, selection, [], remaining, 36.0, MUCH_LEFT, 0.1).sentence
    )


def test_the_rates_of_axle_forces_are_those_that_residual_forces_come_from():
    problem, selection = nominal_only("drive_gain", 0.0)
    path = selection.linearisation.path
    by_force = np.asarray(rates_of_forces(sedan().build(), path))
    z, u = np.asarray(path.z), np.asarray(path.u)
    for axle, force in enumerate(np.eye(3)[1:]):  # Fx, Fyf, Fyr
        back = disturbance_forces(sedan(), z[..., :3], u[..., 0], by_force[..., axle])
        np.testing.assert_allclose(back, np.broadcast_to(force, back.shape), atol=1e-9)


def test_the_interval_of_a_term_is_as_wide_as_blocks_vary():
    """Errors that stay the same for a whole block: the term that suits them best is hardly beyond its interval."""
    problem, selection = nominal_only("drive_gain", 0.0)
    rng, block = np.random.default_rng(4), problem.data.block
    for _ in range(3):
        e = np.asarray(selection.linearisation.e)
        e = np.where(e != 0, rng.standard_normal((problem.data.num_blocks, e.shape[2]))[block], 0.0)
        _, term = best_term(
            problem, generic_terms(problem, selection.linearisation._replace(e=e), selection.scores, (), 0)
        )
        assert 0 < abs(term.value) < 2.5 * term.half_width


def test_noise_taken_for_a_third_of_what_it_is_makes_no_name_surer():
    stated = []
    problem, selection = nominal_only("drive_gain", 0.0)
    member = int(np.argmax(selection.scores.gain))
    columns = problem.columns((member,))
    third = problem.noise._replace(sigma=problem.noise.sigma / 3, disturbance=problem.noise.disturbance / 3)
    for one in (problem, with_noise(problem, problem.start, third)):
        fit, at = refit_to_convergence(one, evaluate_fit(one, problem.start), columns)
        remaining = scores(one, at, fit.theta, (member,), 0)
        whole = Selection((member,), fit, at, remaining, one, fit, remaining)
        model = quadratic_cost(one, fit, at)
        stated.append(effect_probabilities(one, whole, model, member)[member])
        p_value = own_scores(one, whole, model, member).p_value_of(member, columns)
        assert p_value == pytest.approx(selection.scores.p_value_of(member, columns), abs=0.1)
    assert 0.1 < stated[0] < 0.95 and stated[1] == pytest.approx(stated[0], abs=0.1)


def test_an_effect_that_is_left_out_takes_no_part():
    problem, selection = nominal_only("drive_gain", 2.5)
    column = ORDER.index("drive_gain")
    assert not problem.active[column] and problem.active.sum() == len(ORDER) - 1
    assert selection.scores.T[column] == 0 == selection.scores.gain[column] and not selection.scores.H[column].any()


def test_nothing_is_left_of_a_car_without_effects():
    remaining = find_unexplained(*nominal_only("drive_gain", 0.0), 0)
    assert not remaining.significant and remaining.p_value > 0.05


def test_the_next_manoeuvre_should_tell_rivals_apart():
    problem, selection = nominal_only("drive_gain", 0.0)
    own, rival = ORDER.index("load_transfer_long"), ORDER.index("friction_rear")
    fit = selection.fit._replace(theta=hidden(load_transfer_long=0.2))
    selection = selection._replace(selected=(own,), fit=fit)
    cause = Cause(own, np.array([0.2]), np.array([0.1]), 0.6, {rival: 0.4}, (), 1.0, 0.001, 0.6, ALL, FREE)
    ask = lambda verdict: propose_manoeuvre(sedan(), problem, selection, [cause], Judgement(verdict, ""), 0)
    assert ask(Verdict.NAMED) is None
    proposal = ask(Verdict.SET)
    assert proposal is not None and proposal.now == pytest.approx(0.6) and proposal.now < proposal.after <= 1
    assert (
        proposal.after == max(proposal.others.values()) == proposal.others[proposal.manoeuvre]
        and proposal.manoeuvre in proposal.sentence
    )
    assert min(proposal.others.values()) < proposal.after  # coasting straight tells little of load transfer in a drift


@pytest.mark.parametrize(("rate", "driven"), [(100.0, 100.0), (10.0, 20.0), (8.0, 24.0)])
def test_a_car_that_cannot_drift_is_offered_what_it_can_drive_at_the_rate_of_its_log(monkeypatch, rate, driven):
    def record(vehicle, theta, campaign):
        if "drift" in campaign.manoeuvres[0]:
            raise NoDrift("it has no drift equilibrium.")
        assert campaign.rate == driven
        t = np.arange(48) / campaign.rate
        return (Run(campaign.manoeuvres[0], t, t, t, t, t, t, 1 / campaign.rate),), None

    monkeypatch.setattr(next_manoeuvre, "record_runs", record)
    runs = next_manoeuvre.drivable_runs(sedan(), np.zeros(1), rate, 0)
    assert [run.name for run in runs] == [name for name in MANOEUVRES if "drift" not in name]
    assert all(run.dt == pytest.approx(1 / rate) for run in runs)


def test_a_drift_that_there_is_not_is_refused_by_its_name():
    soft = replace(sedan(), B=1.0)
    with pytest.raises(NoDrift, match="it has no drift equilibrium; give 'combined_slip' or another tyre"):
        MANOEUVRES["drift"](soft, np.random.default_rng(0), np.arange(10) * 0.01)


def test_parameters_keep_their_effects_in_the_whole_catalogue():
    problem, _ = nominal_only("drive_gain", 0.0)
    theta = in_full_catalogue(problem, np.arange(1.0, len(ORDER) + 1))
    at = 0
    for name, effect in CATALOGUE.items():
        expected = ORDER.index(name) + 1 if name in ORDER else 0
        np.testing.assert_array_equal(theta[at : at + len(effect.parameters)], expected)
        at += len(effect.parameters)
