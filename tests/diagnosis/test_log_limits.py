"""Logs without sideslip or drive force: what is inferred instead, what is named all the same, what is not judged."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diagnosis.recorded import DT, EFFECTS, ORDER, build_problem, hidden, recorded, sedan

from driftjax.core import Control, State
from driftjax.diagnosis.acceleration import with_inertial_force
from driftjax.diagnosis.evidence import find_causes, named_effects
from driftjax.diagnosis.fit import Problem, depends_on_force, information, initial_noise, initial_problem
from driftjax.diagnosis.gain import predict
from driftjax.diagnosis.log_limits import Unidentifiable, find_unidentifiable, information_with_sideslip
from driftjax.diagnosis.naming import name_effects
from driftjax.diagnosis.noise import UNMEASURED_RISE
from driftjax.diagnosis.observer import command_derivatives, command_response, samples_in_run
from driftjax.diagnosis.propose import added_information
from driftjax.diagnosis.resolve import resolved_log
from driftjax.diagnosis.rivals import share_among_alike
from driftjax.diagnosis.runs import run_observer, take
from driftjax.logs import Log, Run
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import effects_by_name
from driftjax.vehicle.effect.flow import Aux, Place

EXACT = ("psi", "s")  # columns that stay: they do not tell the sideslip


def without(runs: tuple[Run, ...], *channels: str) -> tuple[Run, ...]:
    return tuple(
        replace(run, extra={name: run.extra[name] for name in EXACT},
                **{name: np.full(len(run.t), np.nan) for name in channels})
        for run in runs
    )  # fmt: skip


def drive_forces(problem: Problem, theta: np.ndarray) -> np.ndarray:
    """Drive force (P, T) with which the car `theta` accelerates as measured."""
    path = run_observer(problem.model, problem.data, theta, problem.gains)
    model, zero = problem.model.with_parameters(jnp.asarray(theta)), jnp.zeros(())
    place, aux = Place(zero, zero, zero, zero), Aux(jnp.zeros(2), zero)
    force = lambda z, u: model.flow(State(z[0], z[1], z[2]), Control(u[0], u[1]), place, aux).u.Fxr
    return np.asarray(jax.vmap(jax.vmap(force))(path.z, path.u))


@functools.cache
def measured() -> tuple[Run, ...]:
    return recorded(hidden(yaw_inertia=1.0), 5, 6)


@functools.cache
def named():
    """What is named without sideslip."""
    return name_effects(build_problem(sedan(), EFFECTS, without(measured(), "beta")))


def test_without_sideslip_the_observer_infers_it_and_the_cause_is_named():
    problem, selection = named()
    assert [ORDER[i] for i in selection.selected] == ["yaw_inertia"]
    assert selection.fit.theta[ORDER.index("yaw_inertia")] == pytest.approx(1.0, abs=0.3)
    path = run_observer(problem.model, problem.data, selection.fit.theta, problem.gains)
    for piece, run in zip(np.asarray(path.z)[..., 1], measured(), strict=True):
        error = (piece[: len(run.t)] - run.beta)[problem.data.skip :]
        assert np.sqrt(np.mean(error**2)) < 0.03  # of drifts at 0.4; the sensor's own noise is 0.009


def test_a_channel_that_says_nothing_of_the_car_keeps_its_first_noise():
    """Else its noise would be what makes the other channels' innovations smallest: a speed that nobody believes."""
    for silent, problem in ((1, named()[0]), (0, build_problem(sedan(), EFFECTS, without(measured(), "Fxr")))):
        first, noise = initial_noise(problem.data), problem.noise
        assert noise.sigma[silent] == pytest.approx(first.sigma[silent])
        assert noise.disturbance[silent] <= UNMEASURED_RISE * first.disturbance[silent] * (1 + 1e-9)
        others = [i for i in range(3) if i != silent]
        assert np.all(noise.sigma[others] != first.sigma[others])


def test_predictions_are_compared_in_the_channels_that_were_measured():
    problem, selection = named()
    assert problem.measured.tolist() == [True, False, True]
    error = predict(problem, selection.fit.theta).error
    assert np.isnan(error[..., 1]).all() and np.isfinite(error[..., 0]).any() and np.isfinite(error[..., 2]).any()
    assert predict(problem, selection.fit.theta).starts[0] >= problem.data.skip > 0


def test_a_sideslip_sensor_would_add_information_and_the_sentence_says_what():
    problem, selection = named()
    without_it, with_it = information(selection.linearisation.J), information_with_sideslip(problem, selection)
    assert (np.diag(with_it) > 0.99 * np.diag(without_it)).all()  # whitened again, by another noise
    front = ORDER.index("stiffness_front")
    assert with_it[front, front] > 1.5 * without_it[front, front]
    unidentifiable = find_unidentifiable(problem, selection, {i: () for i in selection.selected})
    assert unidentifiable.channels == ("beta",) and unidentifiable.sentence.startswith("The log has no sideslip;")


def test_a_proposed_manoeuvre_is_judged_by_the_channels_that_the_log_has():
    """The library drives with a sideslip sensor, whose information this log cannot get."""
    problem, selection = named()
    runs = without(measured()[:2])
    added = added_information(sedan(), problem, selection, runs)
    of_log = [information(selection.linearisation.J[problem.data.run == i]) for i in range(2)]
    np.testing.assert_allclose(added, of_log, rtol=0.05, atol=0.01 * np.abs(of_log).max())
    front, better = ORDER.index("stiffness_front"), information_with_sideslip(problem, selection)
    assert sum(H[front, front] for H in added) < 0.8 * better[front, front]


def test_where_sideslip_and_force_are_missing_the_sentence_says_what_small_effects_may_be():
    caution = "may stand for errors of that force"
    assert caution in Unidentifiable(("beta", "Fxr"), {}, {}, ()).sentence
    assert not any(caution in Unidentifiable((one,), {}, {}, ()).sentence for one in ("beta", "Fxr"))


@pytest.mark.slow
def test_without_force_late_sensors_and_a_late_steering_are_as_probable():
    """The force follows from the late speed, so that all the car does is late by as much, as after late commands."""
    late = 3
    back = lambda column: np.r_[np.full(late, np.nan), column[:-late]]
    runs = tuple(replace(run, V=back(run.V), beta=back(run.beta), r=back(run.r)) for run in recorded(hidden(), 5, 6))
    effects = effects_by_name(("steer_delay", "channel_delay", "yaw_inertia"))
    problem, selection = name_effects(build_problem(sedan(), effects, without(runs, "Fxr")))
    (cause,) = named_effects(problem, find_causes(problem, selection))
    assert {cause.effect, *cause.rivals} == {"steer_delay", "channel_delay"}
    assert [cause.probability, *cause.rivals.values()] == pytest.approx([0.5, 0.5], abs=0.01)
    assert max(one["value"] for one in cause.parameters.values()) == pytest.approx(late * DT, abs=0.005)


@pytest.mark.parametrize("channels", [("Fxr",), ("Fxr", "beta")])
def test_sensors_are_as_late_as_a_steering_only_where_all_are_and_no_force_is_on_time(channels):
    effects = effects_by_name(("steer_delay", "channel_delay", "yaw_inertia"))
    steer, sensors, other = ([one.name for one in effects].index(name) for name in
                             ("steer_delay", "channel_delay", "yaw_inertia"))  # fmt: skip
    problem, share = initial_problem(sedan(), effects, without(measured()[:1], *channels)), np.array([0.2, 0.6, 0.2])
    theta = np.zeros(len(problem.owner))
    told_apart = lambda member, known=problem: share_among_alike(known, (member,), theta, member, share)
    equal = (share[steer] + share[sensors]) / 2
    assert told_apart(steer)[[steer, sensors]] == pytest.approx(equal)
    late = problem.columns((sensors,))
    for signs in (0.03, -0.03):  # of parameters, or of their differences between two logs
        theta[late] = signs * np.array([1.2, 0.0 if "beta" in channels else 0.9, 1.0])
        assert told_apart(sensors)[[steer, sensors]] == pytest.approx(equal)
        assert told_apart(other) is share
    assert share_among_alike(problem, (steer, sensors), theta, sensors, share) is share
    theta[late[0]] = 0.0
    assert told_apart(sensors) is share
    assert told_apart(steer, problem._replace(data=problem.data._replace(force_known=True))) is share


def test_the_force_is_estimated_from_the_speed_and_nothing_that_depends_on_it_is_judged():
    runs = without(measured(), "Fxr")
    problem = initial_problem(sedan(), EFFECTS, runs)
    forces = zip(drive_forces(problem, problem.start), measured(), strict=True)
    error = np.concatenate([piece[: len(run.t)] - run.Fxr for piece, run in forces])
    assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean(np.concatenate([run.Fxr for run in measured()]) ** 2))
    judged = {effect.name for effect, active in zip(EFFECTS, problem.active, strict=True) if active}
    assert judged == {effect.name for effect in EFFECTS if not depends_on_force(effect)}
    assert {"drive_gain", "aero_drag", "load_transfer_long"}.isdisjoint(judged) and "yaw_inertia" in judged
    assert problem.measured.tolist() == [False, True, True]
    assert not initial_problem(sedan(), EFFECTS, measured()).unidentifiable_effects


def test_the_speed_that_the_force_was_estimated_from_is_known_and_updates_nothing_else():
    """Sideslip and yaw rate would be corrected by the errors of a speed that their force depends on already."""
    problem = build_problem(sedan(), EFFECTS, without(measured(), "Fxr"))
    L, P, padded = np.asarray(problem.gains.L), np.asarray(problem.gains.P), problem.data.padded
    there = samples_in_run(np.asarray(padded.valid))
    assert (L[there][:, 0, 0] == 1.0).all() and (L[there][:, 1, 1] > 1e-3).all()
    assert not L[..., 1:, 0].any() and not P[..., 0].any()
    path = run_observer(problem.model, problem.data, problem.start, problem.gains)
    V, smooth = np.asarray(path.z)[..., 0][there], np.asarray(padded.V)[:, -there.shape[1] :][there]
    np.testing.assert_allclose(V, smooth, rtol=1e-9)
    assert np.std(V - np.asarray(padded.y)[..., 0][there]) > 0.5 * problem.noise.sigma[0]
    assert problem.noise.disturbance[0] > 0.0


def test_without_both_the_force_follows_the_sideslip_that_the_observer_infers():
    """In a drift the rear axle pushes the car along: without the sideslip that is taken for drive force."""
    (run,) = [run for run in measured() if run.name.startswith("drift")][:1]
    problem = initial_problem(sedan(), EFFECTS, without((run,), "beta", "Fxr"))
    estimated = drive_forces(problem, problem.start)[0][: len(run.t)]
    settled = slice(problem.data.skip, round(5.5 / DT))
    size = lambda error: np.sqrt(np.mean(error[settled] ** 2))
    (no_slip,) = with_inertial_force(sedan(), (run,))
    assert size(estimated - run.Fxr) < 0.8 * size(no_slip.Fxr - run.Fxr)


def test_a_force_estimated_from_a_late_speed_acts_earlier():
    (run,), effects, late = measured()[:1], effects_by_name(("steer_gain", "channel_delay")), 2
    delayed = replace(run, V=np.r_[np.full(late, np.nan), run.V[:-late]])
    on_time, problem = (initial_problem(sedan(), effects, without((one,), "Fxr")) for one in (run, delayed))
    theta = np.array([0.0, late * DT, 0.0, 0.0]) / np.asarray(problem.model.scale)
    piece = take(problem.data.padded, 0)
    force = lambda theta: command_response(problem.model.with_parameters(jnp.asarray(theta)), piece, DT)[:, 1]
    expected = command_response(on_time.model, take(on_time.data.padded, 0), DT)[:, 1]
    size = lambda a: float(np.sqrt(np.mean(np.square(a[-len(piece.y) :][20 : len(run.t) - 20]))))
    assert size(force(theta) - expected) < 0.1 * size(force(0 * theta) - expected)
    theta[1:] += 0.3 * DT / np.asarray(problem.model.scale)[1:]
    by_u = np.asarray(command_derivatives(problem.model, jnp.asarray(theta), piece, DT)[0])[:, 1]
    for k, step in enumerate(1e-4 * np.eye(4)):
        slope = np.asarray(force(theta + step) - force(theta - step)) / 2e-4
        np.testing.assert_allclose(by_u[:, k], slope[-len(by_u) :], atol=1e-6 * size(expected))


def test_samples_that_do_not_resolve_the_car_any_better_are_left_out():
    """Of a sedan at 1000 Hz; the small car, three times as fast, keeps three times as many, one at 100 Hz stays."""
    (run,) = measured()[:1]
    fast = Log((replace(run, t=run.t / 10, dt=run.dt / 10),))
    for vehicle, dt in ((load_vehicle("sedan"), 0.014), (load_vehicle("rc"), 0.004)):
        assert resolved_log(vehicle, fast).runs[0].dt == pytest.approx(dt)
        most = 1.01 * np.sqrt((vehicle.a + vehicle.b) / 9.81) / 40
        assert dt <= most < dt + 0.001  # the next is too long
    assert resolved_log(sedan(), Log(measured())).runs == measured()


def test_the_force_is_that_of_the_car_with_its_effects_not_of_the_nominal_one():
    """Less grip of the rear, which in a drift holds the car back: the nominal car's force is too large."""
    theta = hidden(friction_rear=-3.0)
    (run,) = [run for run in recorded(theta, 5, 6) if run.name.startswith("drift")][:1]
    problem = initial_problem(sedan(), EFFECTS, without((run,), "Fxr"))
    inner = slice(10, len(run.t) - 10)
    off = [np.mean((drive_forces(problem, one)[0][: len(run.t)] - run.Fxr)[inner]) for one in (theta, 0 * theta)]
    assert abs(off[0]) < 0.3 * abs(off[1]) and off[1] > 0
