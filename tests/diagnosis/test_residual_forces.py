"""Residual forces: the map from rates, the smoother against a dense solution, bins, and a hidden effect at one axle."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, ORDER, build_problem, hidden, recorded, sedan

from driftjax.core import Control, State
from driftjax.diagnosis.force_bins import BINS, best_variable, bin_forces, describe_worst, summarise_forces
from driftjax.diagnosis.noise_model import Noise, decay_of
from driftjax.diagnosis.observer import Path, Steps, samples_in_run
from driftjax.diagnosis.residual import (
    FORCES,
    ResidualForces,
    disturbance_forces,
    force_limits,
    nominal_noise,
    observer_path,
    residual_forces,
)
from driftjax.diagnosis.smooth import kalman_filter, linear_model, smooth_disturbances

DT = 0.02
NOISE = Noise(np.array([0.05, 0.01, 0.02]), np.array([0.5, 0.2, 0.8]), 0.4, np.array([0.03, 0.02, 0.01]), 0.2)


def states(rng, num: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """Drifting and gripping states (num, 3), and steering angles (num,)."""
    x = np.stack([rng.uniform(5, 25, num), rng.uniform(-0.8, 0.8, num), rng.uniform(-1.5, 1.5, num)], axis=1)
    return x, rng.uniform(-0.6, 0.6, num)


def test_a_known_force_at_each_axle_is_found_from_the_rates_it_causes():
    rng, car = np.random.default_rng(1), sedan().build()
    x, delta = states(rng)
    extra = rng.normal(0, 1000, (50, 3))
    push = []
    for row, angle, (Fx, Fyf, Fyr) in zip(x, delta, extra, strict=True):
        at = State(*map(jnp.asarray, row))
        more = car.rates(at, Control(jnp.asarray(angle), jnp.asarray(Fx)), jnp.asarray(Fyf), jnp.asarray(Fyr))
        none = car.rates(at, Control(jnp.asarray(angle), jnp.zeros(())), jnp.zeros(()), jnp.zeros(()))
        push.append(np.array(more) - np.array(none))
    np.testing.assert_allclose(disturbance_forces(sedan(), x, delta, np.stack(push)), extra, rtol=1e-6, atol=1e-6)


def test_forces_mirror_with_the_car():
    x, delta = states(np.random.default_rng(2))
    push, mirror = np.random.default_rng(3).normal(size=(50, 3)), np.array([1, -1, -1])
    np.testing.assert_allclose(
        disturbance_forces(sedan(), x * mirror, -delta, push * mirror),
        disturbance_forces(sedan(), x, delta, push) * mirror, rtol=1e-12,
    )  # fmt: skip


def made_up(num: int = 40, seed: int = 4) -> tuple[Path, Steps, np.ndarray]:
    """Measurements (1, num) of a linear car seen from a path at rest, some missing, the last ones padding."""
    rng = np.random.default_rng(seed)
    A = np.array([[0.99, 0.1, 0.0], [0.0, 0.97, -0.02], [0.01, 0.05, 0.98]])
    valid = (rng.uniform(size=(1, num, 3)) > 0.2).astype(float)
    valid[:, num - 8 :] = 0.0
    valid[:, num - 9] = 1.0
    e = valid * rng.normal(size=(1, num, 3)) * 3 * NOISE.sigma
    zero = np.zeros((1, num, 6))
    still = zero[..., :3]
    path = Path(*map(jnp.asarray, (e, zero, zero, zero, zero[..., :4], still, still, e, valid)))
    many = lambda a: jnp.asarray(np.broadcast_to(a, (1, num, *a.shape)))
    D, none = np.eye(3), np.zeros((3, 1))
    full = np.zeros((6, 6))
    full[:3, :3] = A
    first = jnp.zeros((1, 6, 1))
    C, slip = many(np.zeros((6, 1))), many(np.zeros((2, 3)))
    push = many(np.vstack([DT * (np.eye(3) + A) / 2, np.zeros((3, 3))]))
    return path, Steps(many(full), C, many(D), many(none), slip, push, jnp.asarray(still), path.valid, first), valid


@pytest.mark.parametrize("speed_known", [False, True])
def test_the_smoother_is_the_conditional_mean_of_all_that_was_measured(speed_known):
    """A known speed has no error: none that moves to other channels, and none to be measured."""
    path, steps, valid = made_up()
    read_valid = valid * [not speed_known, 1, 1]
    A, T = np.asarray(steps.A)[0, 0, :3, :3], int(samples_in_run(valid).sum())
    decays = np.exp(-DT / np.repeat([NOISE.correlation, NOISE.slow_correlation], 3))
    sizes, slow = np.concatenate([NOISE.disturbance, NOISE.slow]), np.diag(NOISE.slow**2)
    F, Q = np.zeros((9, 9)), np.diag([0, 0, 0, *((1 - decays**2) * sizes**2)])
    F[:3, :3], F[:3, 3:6], F[3:, 3:] = A, np.asarray(steps.push)[0, 0, :3], np.diag(decays)
    C = np.zeros((T, 9, T, 9))  # covariance of w at all times
    C[0, :, 0] = np.diag([*(4 * NOISE.sigma**2 + NOISE.slow**2), *sizes**2])
    C[0, :3, 0, 6:] = C[0, 6:, 0, :3] = -slow  # the first state is the measured one
    if speed_known:
        F[0] = F[:, 0] = C[0, 0] = C[:, :, 0, 0] = 0.0
    for k in range(1, T):
        for j in range(k):
            C[k, :, j] = F @ C[k - 1, :, j]
            C[j, :, k] = C[k, :, j].T
        C[k, :, k] = F @ C[k - 1, :, k - 1] @ F.T + Q
    which = np.flatnonzero(read_valid[0, :T].ravel())
    read = np.kron(np.eye(T), np.hstack([np.eye(3), np.zeros((3, 3)), np.eye(3)]))[which]  # state plus slow error
    C, y = C.reshape(9 * T, 9 * T), np.asarray(path.e)[0, :T].ravel()[which]
    S = read @ C @ read.T + np.diag(np.tile(NOISE.sigma**2, T)[which])
    expected = (C @ read.T @ np.linalg.solve(S, y)).reshape(T, 9)
    x, d = smooth_disturbances(path, steps, valid, NOISE, DT, speed_known=speed_known)
    np.testing.assert_allclose(x[0, :T], expected[:, :3], atol=1e-8)
    np.testing.assert_allclose(d[0, :T], expected[:, 3:6], atol=1e-8)
    assert np.isfinite(x).all() and np.isfinite(d).all()


def test_an_unstable_car_is_smoothed_over_a_long_run():
    path, steps, valid = made_up(1000)
    A = np.asarray(steps.A).copy()
    A[..., :3, :3] = [[1.0, -1.0, 0.2], [0.0, 1.05, 0.1], [0.1, 3.0, 1.1]]
    assert np.abs(np.linalg.eigvals(A[0, 0, :3, :3])).max() > 1.15
    steps = steps._replace(A=jnp.asarray(A))
    spread = kalman_filter(linear_model(path, steps, valid, decay_of(NOISE, DT)), NOISE, DT).covariance
    np.testing.assert_allclose(spread, spread.swapaxes(-1, -2), atol=1e-12)
    driven = samples_in_run(valid)
    assert np.linalg.eigvalsh(spread[driven]).min() > 0 and spread[driven].max() < 2
    x, d = smooth_disturbances(path, steps, valid, NOISE, DT)
    assert np.abs(x[driven]).max() < 1 and np.abs(d[driven]).max() < 10


def draw_forces(rng, num: int = 6000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forces that wander with time, two drivers that wander on their own, and blocks of 200."""
    wander = lambda: np.convolve(rng.normal(size=num + 49), np.ones(50) / 7, "valid")
    return np.stack([wander() for _ in range(3)], axis=1), np.stack([wander(), wander()]), np.arange(num) // 200


def test_bins_find_the_driver_and_how_much_it_explains():
    rng = np.random.default_rng(5)
    forces, (one, two), block = draw_forces(rng)
    forces[:, 2] += 2 * one
    summary = summarise_forces(ResidualForces(100 * forces, {"speed": two, "slip_rear": one}, block), 0)
    assert summary.p_value < 0.01 and best_variable(summary, 2) == "slip_rear"
    assert summary.variables["slip_rear"].explained[2] == pytest.approx(4 / 5, abs=0.1)
    assert summary.variables["speed"].explained[2] < 0.2
    np.testing.assert_allclose(summary.rms[2], 100 * np.sqrt(5), rtol=0.15)
    words = describe_worst(summary, sedan())
    assert "rear axle" in words and "rear slip angle" in words and " N RMS" in words


def test_forces_that_go_with_nothing_are_rarely_reported_to():
    summaries = [summarise_forces(ResidualForces(f, {"a": d[0], "b": d[1]}, b), k) for k, (f, d, b) in
             ((k, draw_forces(np.random.default_rng(100 + k))) for k in range(40))]  # fmt: skip
    assert sum(one.p_value < 0.05 for one in summaries) <= 6
    assert np.mean([one.variables["a"].explained for one in summaries]) < 0.05


def test_a_driver_that_hardly_varies_and_bins_of_one_block_are_left_out():
    rng = np.random.default_rng(6)
    forces, (one, _), block = draw_forces(rng)
    signs = np.ones((2, block.max() + 1))
    assert bin_forces(np.full(len(one), 3.0), forces, block, signs) is None
    once = np.where(block == 7, 50.0, one)  # one block far away
    bins = bin_forces(once, forces, block, signs)
    assert bins is not None and len(bins.value) <= BINS and (np.diff(bins.value) > 0).all()
    assert np.isfinite(bins.mean).all() and np.isfinite(bins.error).all()


@functools.cache
def left_over(name: str, size: float):
    """Residual forces of the nominal car on a recording of one with a hidden effect."""
    return summary_of(recorded(hidden(**{name: size}), 3, 4))


def summary_of(runs):
    problem = build_problem(sedan(), EFFECTS, runs)
    path, steps = observer_path(problem, np.zeros(len(ORDER)))
    noise = nominal_noise(problem, path, steps)
    return summarise_forces(residual_forces(sedan(), problem, path, steps, noise, runs), 0), noise, problem.noise


def test_hidden_rear_friction_shows_at_the_rear_axle_and_as_disturbances():
    summary, noise, given = left_over("friction_rear", -2.0)
    size = np.max([one.systematic for one in summary.variables.values()], axis=0) / force_limits(sedan())
    assert summary.p_value < 0.05 and FORCES[int(np.argmax(size))] == "Fyr"
    assert size[2] > 2 * size[1]
    assert "rear axle" in describe_worst(summary, sedan())
    assert (noise.disturbance > 1.2 * given.disturbance).any()
    # rear friction is short by 2 typical sizes, and with it the saturated rear force
    assert 0.3 < size[2] / (2 * EFFECTS[ORDER.index("friction_rear")].parameters[0].typical) < 1.2


def test_a_drive_force_that_was_estimated_has_no_residual():
    runs = recorded(hidden(friction_rear=-2.0), 3, 4)
    summary, *_ = summary_of(tuple(dataclasses.replace(run, Fxr=np.full_like(run.t, np.nan)) for run in runs))
    assert np.isnan(summary.rms[0]) and np.isfinite(summary.rms[1:]).all() and 0 < summary.p_value <= 1
    assert best_variable(summary, 0) is None and (summary.rms[1:] < 0.5 * force_limits(sedan())[1:]).all()
    assert "axle" in describe_worst(summary, sedan()) and "nan" not in describe_worst(summary, sedan())
