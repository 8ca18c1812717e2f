"""Minimum-time plans: IPOPT on the same transcription, physics of the drift, mirror, labels, honest failure."""

import dataclasses
from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import RESULTS, BadInput, Control, State, rk4_step
from driftjax.planner import Plan, PlanConfig, load_plan_config, plan
from driftjax.planner.nodes import nodes
from driftjax.planner.planner import problem
from driftjax.planner.problem import MinimumTime
from driftjax.planner.stages import device, guesses, stages, tight_corners
from driftjax.studies.bench.casadi_plan import CasadiPlan
from driftjax.track import load_track
from driftjax.track.build import corner, playground
from driftjax.vehicle import load_vehicle

G = 9.81

# The published car at minimum time and nothing else; the shipped options are tested by their own case.
PUBLISHED = {
    "sedan": PlanConfig(entry_speed=12.31),
    "rc": PlanConfig(
        entry_speed=3.016, V_min=0.8, V_max=8.0, beta_d=0.261799, drift_radius=1.2, drift_from=0.35, drift_to=0.85
    ),
}


@cache
def setup(car: str, drift: bool):
    config = dataclasses.replace(PUBLISHED[car], drift=drift)
    return load_track(f"{car}_corner"), load_vehicle(car), config


@cache
def solved(car: str, drift: bool) -> Plan:
    return plan(*setup(car, drift))


CASES = [("sedan", True), ("sedan", False), ("rc", True), ("rc", False)]


@pytest.mark.parametrize("car, drift", CASES)
def test_ipopt_finds_the_same_time_and_the_plan_keeps_its_limits(car, drift):
    compare_with_ipopt(solved(car, drift), *setup(car, drift))


@pytest.mark.slow
@pytest.mark.parametrize("car", ["sedan", "rc"])
def test_ipopt_finds_the_same_time_with_the_shipped_options(car):
    """Friction circle, fair speed, price on the course: the oracle has its own copy of each."""
    track, vehicle, config = load_track(f"{car}_corner"), load_vehicle(car), load_plan_config(car)
    compare_with_ipopt(plan(track, vehicle, config), track, vehicle, config)


def compare_with_ipopt(solution: Plan, track, vehicle, config):
    assert solution.result == RESULTS.successful and float(solution.violation) < 1e-6
    vehicle = config.planned(vehicle)
    at = nodes(track, vehicle.a + vehicle.b, config)
    stage, corners = stages(track, vehicle, config, at.s)
    ds = at.s[1] - at.s[0]
    scale = np.asarray(problem(vehicle, config, stage, ds).scale)
    guess = guesses(at.s, stage, corners, vehicle, config)[0]
    states, _, success = CasadiPlan(vehicle, config, stage, ds, scale).solve(guess)
    assert success
    slowness = (1 - states[:, 3] * np.asarray(stage.kappa)[:, 0]) / (states[:, 0] * np.cos(states[:, 1] + states[:, 4]))
    time = np.sum(np.asarray(stage.share) * slowness) * ds
    assert float(solution.lap_time) == pytest.approx(time, rel=3e-3)
    assert np.all((solution.V >= config.V_min) & (solution.V <= config.V_max))
    assert np.all((solution.e <= stage.e_max + 1e-4) & (solution.e >= stage.e_min - 1e-4))
    assert np.all(np.abs(solution.delta) <= vehicle.delta_max + 1e-4)
    assert np.all((solution.Fxr <= vehicle.Fxr_max * (1 + 1e-4)) & (solution.Fxr >= vehicle.Fxr_min * (1 + 1e-4)))
    assert np.all(-stage.side * solution.beta >= stage.slip - 1e-4)
    h = np.diff(solution.t)
    assert np.all(np.abs(np.diff(solution.delta)) <= vehicle.delta_rate_max * h * 1.001 + 1e-6)
    assert np.all(np.abs(np.diff(solution.Fxr)) <= vehicle.Fxr_rate_max * h * 1.001 + 1e-6 * vehicle.Fxr_max)


def test_plan_is_a_trajectory_of_the_nominal_car():
    solution = solved("sedan", True)
    model = setup("sedan", True)[1].build()

    def world(x, u):  # state (car, x, y, psi)
        dx = model(x[0], u)
        course = x[3] + x[0].beta
        return dx, x[0].V * jnp.cos(course), x[0].V * jnp.sin(course), x[0].r

    def step(k):
        h, at = solution.t[k + 1] - solution.t[k], lambda v: v[k]
        start = (
            State(solution.V[k], solution.beta[k], solution.r[k]),
            at(solution.x),
            at(solution.y),
            at(solution.psi),
        )
        middle = Control((solution.delta[k] + solution.delta[k + 1]) / 2, (solution.Fxr[k] + solution.Fxr[k + 1]) / 2)
        (car, x, y, psi) = rk4_step(lambda w: world(w, middle), start, h)
        return car.V - solution.V[k + 1], x - solution.x[k + 1], y - solution.y[k + 1], psi - solution.psi[k + 1]

    wrong = jax.jit(jax.vmap(step))(jnp.arange(len(solution.t) - 1))
    for error, size in zip(wrong, (0.02, 2e-3, 2e-3, 2e-3), strict=True):
        assert np.abs(error).max() < size


@pytest.mark.parametrize("car", ["sedan", "rc"])
def test_drift_device_gives_one_drift_in_the_corner(car):
    _, vehicle, config = setup(car, True)
    solution, grip = solved(car, True), solved(car, False)
    start, end = solution.drift_interval()
    assert solution.drift_intervals() == [(start, end)]
    middle = (solution.S > start + 0.3 * (end - start)) & (solution.S < end - 0.3 * (end - start))
    assert np.all(solution.beta[middle] < -0.7 * config.beta_d) and np.all(solution.r[middle] > 0)
    assert np.min(solution.beta) <= -config.beta_d
    load = np.mean((solution.V * solution.r)[middle]) / (vehicle.mu * G)
    assert 0.8 < load < 1.1  # the tyres are at their limit, without a friction circle
    assert grip.drift_intervals() == []
    assert np.all(np.abs(grip.beta) <= config.beta_normal + 1e-5)
    with pytest.raises(ValueError, match="no drift"):
        grip.drift_interval()


def test_sedan_corner_has_the_speed_and_slip_of_a_drift():
    solution = solved("sedan", True)
    start, end = solution.drift_interval()
    middle = (solution.S > start + 0.2 * (end - start)) & (solution.S < end - 0.2 * (end - start))
    assert 10.5 < np.mean(solution.V[middle]) < 13.5
    assert -35 < np.rad2deg(np.mean(solution.beta[middle])) < -19


def test_labels_follow_the_signs_of_sideslip_and_yaw_rate():
    config = setup("sedan", True)[2]
    solution = solved("sedan", True)
    opposite = (solution.beta * solution.r < 0) & (np.abs(solution.beta) > config.label_beta)
    np.testing.assert_array_equal(solution.drift, opposite)
    drift = np.isin(np.arange(solution.drift.size), [3, 4, 5, 9, 300])
    runs = eqx.tree_at(lambda p: (p.drift, p.beta), solution, (drift, np.where(drift, -0.2, 0.0)))
    S = np.asarray(solution.S)
    assert runs.drift_intervals() == [(S[3], S[5]), (S[9], S[9]), (S[300], S[300])]


def test_path_is_the_course_driven_between_the_borders():
    track, solution = setup("rc", True)[0], solved("rc", True)
    path = solution.path
    assert float(path.length) == pytest.approx(float(solution.S[-1])) and not path.closed
    x, y, course, _ = jax.jit(jax.vmap(path.pose))(solution.S)
    np.testing.assert_allclose(x, solution.x, atol=1e-4)
    np.testing.assert_allclose(y, solution.y, atol=1e-4)
    np.testing.assert_allclose(course, solution.psi + solution.beta, atol=2e-3)
    k = np.argmin(np.abs(solution.s - float(track.length) / 2))
    s = np.asarray(solution.S)[k]
    w_right, w_left = map(float, path.widths(s))
    offset = jax.jit(lambda side: track.locate(*path.position(s, side))[1])
    for side in (w_left, -w_right):  # a point on the path's border lies on the track's border
        e = offset(side)
        assert abs(float(e)) == pytest.approx(0.35, abs=0.02)


def test_right_hand_corner_is_the_mirror_image():
    track, vehicle, config = setup("sedan", True)
    mirrored = plan(corner(45, 8, 15, -np.pi, 30, 3), vehicle, config)
    left = solved("sedan", True)
    assert mirrored.result == RESULTS.successful
    assert float(mirrored.lap_time) == pytest.approx(float(left.lap_time), rel=1e-5)
    for name, size in [("beta", 1e-2), ("r", 2e-2), ("e", 2e-2), ("theta", 1e-2), ("y", 2e-2)]:
        np.testing.assert_allclose(getattr(mirrored, name), -getattr(left, name), atol=size, err_msg=name)
    np.testing.assert_array_equal(mirrored.drift, left.drift)


IMPOSSIBLE = {
    "entry far too fast": {"entry_speed": 32.0},
    "entry above V_max": {"V_max": 10.0},
    "no drift without steering back": {"beta_d": 0.85, "end_slip": 0.01, "drift_ramp": 0.01},
}


@pytest.mark.parametrize("change", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_impossible_demands_are_not_called_a_plan(change):
    track, vehicle, config = setup("sedan", True)
    solution = plan(track, vehicle, dataclasses.replace(config, max_steps=60, **change))
    assert solution.result != RESULTS.successful
    assert float(solution.violation) > 1e-4 and solution.result == RESULTS.infeasible


def test_too_few_iterations_are_reported():
    track, vehicle, config = setup("sedan", True)
    solution = plan(track, vehicle, dataclasses.replace(config, max_steps=2))
    assert solution.result != RESULTS.successful and int(solution.num_steps) == 2


def test_other_numbers_and_the_other_car_need_no_new_compile(monkeypatch):
    solved("sedan", True)
    solved("sedan", False)

    def traced_again(*_):
        raise AssertionError("the planner was traced again")

    monkeypatch.setattr(MinimumTime, "slope", traced_again)
    track, vehicle, config = setup("rc", True)
    plan(track, vehicle, dataclasses.replace(config, max_steps=1))
    track, vehicle, config = setup("sedan", True)
    plan(track, replace(vehicle, mu=0.9), dataclasses.replace(config, entry_speed=11.0, beta_d=0.4, max_steps=1))


def test_device_is_for_tight_corners_and_ramps_up():
    config = PlanConfig()
    s = np.linspace(0, 400, 801)
    kappa = np.where((s > 50) & (s < 90), 1 / 15, 0) - np.where((s > 150) & (s < 190), 1 / 16, 0)
    kappa = kappa + np.where((s > 250) & (s < 300), 1 / 40, 0) + np.where((s > 350) & (s < 355), 1 / 10, 0)
    corners = tight_corners(s, kappa, config)
    assert [c.side for c in corners] == [1, -1]  # neither the wide one nor the kink
    side, slip, beta_max = device(s, corners, config)
    assert slip[(s > 60) & (s < 80)] == pytest.approx(config.beta_d)
    assert np.all(slip[(s < 50) | ((s > 92) & (s < 150))] < -1)
    assert np.all(np.diff(slip[(s > 51) & (s < 60)]) >= 0)
    assert side[np.argmin(np.abs(s - 170))] == -1
    assert beta_max[0] == config.beta_normal and beta_max[np.argmin(np.abs(s - 70))] == config.beta_max
    off = device(s, corners, dataclasses.replace(config, drift=False))[1]
    assert np.all(off < -1)


def test_bad_plans_are_refused():
    track, vehicle, config = setup("rc", True)
    with pytest.raises(BadInput, match="0.7 m wide, but the car is 0.8 m wide"):
        plan(track, replace(vehicle, width=0.8), config)
    with pytest.raises(BadInput, match="no room for a car .* lower 'margin'"):
        plan(track, vehicle, dataclasses.replace(config, margin=0.3))
    for key, value in [("V_min", 50.0), ("beta_d", 1.2), ("drift_ramp", 0.6), ("num_nodes", 3), ("lead", 0.0)]:
        with pytest.raises(BadInput, match=f"'{key}'|'drift_from'"):
            PlanConfig(**{key: value})


def test_nodes_of_a_closed_lap_are_a_whole_number_of_steps_between_straights():
    track = playground(1.0, 3.0)
    at = nodes(track, 3.05, PlanConfig())
    assert at.s[at.last] - at.s[at.first] == pytest.approx(float(track.length))
    for k in (0, at.first, at.last):
        assert abs(float(track.pose(at.s[k])[3])) < 1e-9
    assert at.first > 20 and len(at.s) - at.last > 20


@pytest.mark.parametrize(("between", "num"), [(-0.3, 1), (-0.1, 2), (0.3, 2)], ids=["slides on", "grips", "turns over"])
def test_a_drift_ends_where_the_car_slides_no_more(between, num):
    """Two parts with the yaw rate of a drift, and three nodes between them without."""
    solution = solved("sedan", True)
    nodes = np.arange(len(solution.S))
    drift = ((nodes >= 100) & (nodes < 120)) | ((nodes >= 123) & (nodes < 130))
    beta = np.where(drift, -0.2, 0.0) + np.where((nodes >= 120) & (nodes < 123), between, 0.0)
    made = dataclasses.replace(solution, beta=jnp.asarray(beta), drift=jnp.asarray(drift))
    assert len(made.drift_intervals()) == num
    assert made.drift_intervals()[0][0] == float(solution.S[100])
    assert made.drift_intervals()[-1][1] == float(solution.S[129])


@pytest.mark.slow
@pytest.mark.parametrize("car", ["sedan", "rc"])
def test_closed_lap_drifts_its_hairpin_only(car):
    track = load_track(f"{car}_playground")
    solution = plan(track, load_vehicle(car), load_plan_config(car))
    assert solution.result == RESULTS.successful
    assert solution.path.closed and len(solution.drift_intervals()) == 1
    assert float(solution.closing) < 0.1 * float(track.w_left[0])
    start, end = solution.drift_interval()
    k = int(np.argmin(np.abs(np.asarray(solution.S) - (start + end) / 2)))
    assert float(track.pose(solution.s[k])[3]) == pytest.approx(float(track.kappa.max()), rel=1e-2)
