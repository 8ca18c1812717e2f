"""Errors of sensors from pose and accelerations alone, on a motion that no car model made."""

from typing import Any

import numpy as np
import pytest
from diagnosis.recorded import nominal_car

from driftjax.diagnosis.fit import Problem, evaluate_fit, initial_problem, linearise, with_motion_noise
from driftjax.diagnosis.motion import piece_derivatives, piece_residuals, whitened_residuals
from driftjax.diagnosis.select import motion_effects
from driftjax.logs import Run
from driftjax.vehicle.effect import effects_by_name

EFFECTS = effects_by_name(("road_grade", "gyro_bias", "gyro_scale", "sideslip_bias", "speed_scale", "channel_delay"))
NAMES = [f"{effect.name}.{p.name}" for effect in EFFECTS for p in effect.parameters]
DT, ROWS, FINE = 0.02, 1000, 10
SIGMA = np.array([0.02, 0.002, 0.004])  # noise of V, beta, r
POSE = np.array([0.0005, 0.01, 0.01, 0.05, 0.05])  # and of psi, x, y, ax, ay


def motion() -> dict[str, np.ndarray]:
    """A slalom with changing speed, 20 s, at `FINE` times the rate of the log."""
    t = np.arange(ROWS * FINE) * DT / FINE
    V, beta = 12 + 3 * np.sin(0.5 * t), 0.15 * np.sin(1.1 * t + 1) - 0.05
    r = 0.3 * np.sin(1.1 * t) + 0.15 * np.sin(2.9 * t) + 0.05
    h = DT / FINE
    integral = lambda f: np.r_[0.0, np.cumsum((f[1:] + f[:-1]) / 2) * h]
    psi = integral(r)
    x, y = integral(V * np.cos(psi + beta)), integral(V * np.sin(psi + beta))
    vx, vy = V * np.cos(beta), V * np.sin(beta)
    ax, ay = np.gradient(vx, h) - r * vy, np.gradient(vy, h) + r * vx
    return {"t": t, "V": V, "beta": beta, "r": r, "psi": psi, "x": x, "y": y, "ax": ax, "ay": ay}


def run_of(seed: int = 0, late: dict[str, float] | None = None, **error: Any) -> Run:
    """A noisy log of the motion; channels are `late` [s], and each has a pair of factor and offset in `error`."""
    truth, rng, at = motion(), np.random.default_rng(seed), np.arange(ROWS) * DT
    measured = {}
    for name, sigma in zip(("V", "beta", "r", "psi", "x", "y", "ax", "ay"), (*SIGMA, *POSE), strict=True):
        factor, offset = error.get(name, (1.0, 0.0))
        value = np.interp(at - (late or {}).get(name, 0.0), truth["t"], truth[name])
        measured[name] = factor * value + offset + sigma * rng.standard_normal(ROWS)
    extra = {name: measured[name] for name in ("psi", "x", "y", "ax", "ay")}
    still = np.zeros(ROWS)
    return Run("slalom", at, measured["V"], measured["beta"], measured["r"], still, still, DT, extra)


def problem_of(run: Run) -> Problem:
    return with_motion_noise(initial_problem(nominal_car("sedan"), EFFECTS, (run,)))


def estimate(problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
    """Values and standard deviations [SI] of all parameters, from the channels beside V, beta and r alone."""
    scale, fit = np.asarray(problem.model.scale), evaluate_fit(problem, problem.start)
    H = np.eye(len(scale))
    for _ in range(4):
        at = linearise(problem, fit)
        e, J = (np.asarray(a)[:, :, 3:] for a in (at.e, at.J))
        H = np.einsum("ptij,ptik->jk", J, J) + np.eye(len(scale)) / 9
        step = np.linalg.solve(H, np.einsum("ptij,pti->j", J, e) - (fit.theta - problem.start) / 9)
        fit = evaluate_fit(problem, np.clip(fit.theta + step, problem.lower, problem.upper))
    spread = np.sqrt(np.diag(np.linalg.inv(H)))
    return dict(zip(NAMES, fit.theta * scale, strict=True)), dict(zip(NAMES, spread * scale, strict=True))


def named(problem: Problem) -> set[str]:
    start = evaluate_fit(problem, problem.start)
    return {EFFECTS[i].name for i in motion_effects(problem, start, linearise(problem, start), 0, 8)}


def test_errors_of_sensors_are_found_without_a_car():
    late = {"r": 0.05}
    problem = problem_of(run_of(1, late, r=(1.02, 0.01), V=(0.97, 0.0)))
    value, spread = estimate(problem)
    # a reading that is late, then scaled: the bias is as it was set
    truth = {"gyro_bias.p": 0.01, "gyro_scale.p": 0.02, "speed_scale.p": -0.03, "channel_delay.d_r": 0.05}
    for name, true in truth.items():
        assert abs(value[name] - true) < 4 * spread[name], name
        assert spread[name] < 0.2 * abs(true), name
    assert {"gyro_bias", "gyro_scale", "speed_scale", "channel_delay"} == named(problem)


@pytest.mark.parametrize(
    ("late", "error"),
    [
        ({}, {}),
        (dict.fromkeys(("psi", "x", "y"), 0.06), {"psi": (1.0, 0.05), "x": (1.0, 40.0)}),
        (dict.fromkeys(("ax", "ay"), 0.04), {"ax": (1.05, 0.3), "ay": (0.9, -0.4)}),
    ],
    ids=["clean", "pose late and turned", "accelerometers biased, scaled and late"],
)
def test_what_pose_and_accelerometers_err_by_themselves_is_not_blamed_on_others(late, error):
    assert named(problem_of(run_of(2, late, **error))) == set()


def test_the_offset_of_the_heading_is_not_taken_for_one_of_the_sideslip():
    problem = problem_of(run_of(3, psi=(1.0, 0.03)))
    value, spread = estimate(problem)
    assert abs(value["sideslip_bias.p"]) < 0.002
    assert spread["sideslip_bias.p"] > 0.05  # no more is known of it than before


def test_dropouts_and_outliers_are_not_blamed_on_sensors():
    run, rng = run_of(4), np.random.default_rng(4)
    gone = rng.random(ROWS) < 0.05
    for column in (run.r, run.beta, run.extra["psi"], run.extra["x"]):
        column[gone] = np.nan
    run.extra["y"][rng.integers(ROWS, size=5)] += 30.0
    problem = problem_of(run)
    assert problem.motion is not None and problem.motion.used.any(axis=(0, 1)).all()
    assert named(problem) == set()


def test_a_heading_that_was_integrated_from_the_yaw_rate_is_not_used():
    run = run_of(5, r=(1.0, 0.02))
    run.extra["psi"] = np.r_[0.0, np.cumsum((run.r[1:] + run.r[:-1]) / 2) * DT]
    run = Run(run.name, run.t, run.V, run.beta, run.r, run.delta, run.Fxr, DT, {"psi": run.extra["psi"]})
    assert problem_of(run).motion is None


@pytest.mark.parametrize("channel", ["V", "beta"])
def test_the_cost_of_a_delay_has_no_minimum_but_at_its_value(channel: str):
    """Where samples were compared one by one, it had one at each of them, at which a search by derivatives ended."""
    late = {channel: 0.075}
    problem = problem_of(run_of(8, late))
    assert problem.motion is not None
    scale, column, delays = np.asarray(problem.model.scale), NAMES.index(f"channel_delay.d_{channel}"), np.arange(60)
    costs = []
    for delay in DT / 8 * delays:
        theta = np.zeros(len(scale))
        theta[column] = delay / scale[column]
        ((e, missing),) = whitened_residuals(problem.model, problem.data, theta[None], problem.motion)
        costs.append(np.sum(e**2) + missing)
    turns = np.flatnonzero((np.diff(costs[:-1]) < 0) & (np.diff(costs[1:]) > 0)) + 1
    assert len(turns) > 0
    assert (np.abs(DT / 8 * turns - late[channel]) < DT).all()  # a window at the end may come or go
    assert DT / 8 * np.argmin(costs) == pytest.approx(late[channel], abs=DT / 4)


def test_several_cars_have_the_residuals_that_each_has_alone():
    problem = problem_of(run_of(9))
    assert (noise := problem.motion) is not None
    thetas = np.zeros((4, len(NAMES)))
    thetas[1, NAMES.index("channel_delay.d_V")] = 0.4
    thetas[3, NAMES.index("gyro_bias.p")] = -1.0
    of = lambda thetas: whitened_residuals(problem.model, problem.data, thetas, noise)
    for theta, (e, missing) in zip(thetas, of(thetas), strict=True):
        ((alone, lacks),) = of(theta[None])
        np.testing.assert_allclose(e, alone, atol=1e-9)
        assert missing == lacks
    assert np.abs(of(thetas)[1][0] - of(thetas)[0][0]).max() > 0.1


def test_derivatives_agree_with_finite_differences():
    problem = problem_of(run_of(6))
    model, data, scale = problem.model, problem.data, np.asarray(problem.model.scale)
    theta = 0.3 * np.random.default_rng(6).random(len(scale)) + 0.1  # delays of less than a sample
    J, h = np.asarray(piece_derivatives(model, data, theta)), 1e-5
    valid = np.asarray(piece_residuals(model, data, theta).valid) > 0
    for k, step in enumerate(np.eye(len(scale)) * h):
        e = [np.asarray(piece_residuals(model, data, theta + sign * step).e) for sign in (1, -1)]
        np.testing.assert_allclose(J[..., k][valid], (e[1] - e[0])[valid] / (2 * h), rtol=1e-5, atol=1e-6)


def test_residuals_are_zero_for_the_sensors_that_measured():
    run = run_of(7, r=(1.02, 0.01), V=(0.97, 0.0), beta=(1.0, 0.02))
    problem = problem_of(run)
    truth = dict.fromkeys(NAMES, 0.0) | {"gyro_bias.p": 0.01, "gyro_scale.p": 0.02, "speed_scale.p": -0.03,
                                         "sideslip_bias.p": 0.02}  # fmt: skip
    theta = np.array(list(truth.values())) / np.asarray(problem.model.scale)
    assert problem.motion is not None
    for at, least, most in ((theta, 0.6, 1.3), (problem.start, 10.0, np.inf)):
        e = evaluate_fit(problem, at).e[..., 3:]
        assert least < np.sum(e**2) / problem.motion.used.sum() < most
