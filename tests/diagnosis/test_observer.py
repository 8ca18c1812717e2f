"""The observer on recordings of the nominal car: white innovations, their derivatives, gaps, and the noise it finds."""

import functools
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diagnosis.recorded import (
    DT,
    EFFECTS,
    ORDER,
    ROWS,
    build_problem,
    catalogue,
    hidden,
    nominal_car,
    recorded,
    sedan,
    truth,
    with_slow_errors,
)
from scipy.optimize import minimize

from driftjax.diagnosis.fit import initial_noise, with_noise
from driftjax.diagnosis.noise import (
    estimate_noise,
    information_of_noise,
    noise_bounds,
    restricted_likelihood,
    search_scale,
)
from driftjax.diagnosis.runs import (
    BLOCK,
    ERROR_BLOCK,
    PIECE_LENGTH,
    SHORT_PIECE_LENGTH,
    differentiate,
    error_blocks,
    fixed_gain,
    observer_gains,
    pieces,
    run_observer,
    step_derivatives,
    whiten,
)
from driftjax.vehicle.effect import effects_by_name
from driftjax.vehicle.universal import universal_car

NEUTRAL, EVERY = np.zeros(len(ORDER)), np.ones(len(ORDER), bool)
SKIP = 50  # samples until the observer has forgotten its guess of the start
RUN, GAP = 1, slice(200, 260)  # where samples are taken away
VARIED = ("friction_rear", "steer_lag", "gyro_bias", "load_transfer_long", "relaxation_length")


@functools.cache
def nominal_runs():
    runs = recorded(hidden(), seed=1, noise_seed=2)
    assert len(runs) == 6
    return runs


@functools.cache
def watched():
    """Data, gains for the true noise, and whitened innovations (P, T, 3)."""
    data = pieces(sedan(), nominal_runs())
    known = observer_gains(catalogue(), data, NEUTRAL, truth().as_vector())
    path = run_observer(catalogue(), data, NEUTRAL, known)
    return data, known, np.asarray(whiten(known, path.e))


def test_innovations_are_white_and_of_unit_variance():
    e = watched()[2][:, SKIP:ROWS]
    np.testing.assert_allclose((e**2).mean(axis=(0, 1)), 1.0, atol=0.06)
    assert np.abs(e.mean(axis=(0, 1))).max() < 0.06
    for lag in (1, 2, 10):
        assert np.abs((e[:, lag:] * e[:, :-lag]).mean(axis=(0, 1))).max() < 0.08
    across = np.einsum("pti,ptj->ij", e, e) / e[..., 0].size
    assert np.abs(across - np.diag(np.diag(across))).max() < 0.08


def test_what_was_not_measured_has_no_innovation():
    data, known, e = watched()
    assert not e[:, ROWS:].any()
    assert not np.asarray(known.whitening)[:, ROWS:].any() and not np.asarray(known.L)[:, ROWS:].any()


@pytest.mark.parametrize("channels", [("beta",), ("V", "beta", "r")], ids=["one", "all"])
def test_missing_samples_leave_no_trace(channels):
    data, known, e = watched()
    run, index = nominal_runs()[RUN], ["V", "beta", "r"]
    values = {name: getattr(run, name).copy() for name in channels}
    for one in values.values():
        one[GAP] = np.nan
    gappy = pieces(sedan(), (*nominal_runs()[:RUN], replace(run, **values), *nominal_runs()[RUN + 1 :]))
    part = jax.tree.map(lambda a: a[RUN : RUN + 1], gappy.padded)
    alone = gappy._replace(padded=part, run=gappy.run[RUN : RUN + 1])
    filling = observer_gains(catalogue(), alone, NEUTRAL, truth().as_vector())
    whitened = np.asarray(whiten(filling, run_observer(catalogue(), alone, NEUTRAL, filling).e))[0]
    columns = [index.index(name) for name in channels]
    assert np.isfinite(whitened).all() and not whitened[GAP][:, columns].any()
    np.testing.assert_allclose(whitened[: GAP.start], e[RUN, : GAP.start], atol=1e-6)  # the past knows no gap
    after = whitened[GAP.stop : ROWS]
    assert np.abs(after).max() < 5  # no jump, as large as the gap makes it unsure
    np.testing.assert_allclose(after[150:], e[RUN, GAP.stop + 150 : ROWS], atol=0.2)
    assert np.sqrt(((after[150:] - e[RUN, GAP.stop + 150 : ROWS]) ** 2).mean()) < 0.03


@pytest.mark.parametrize("relaxation", [0.0, 0.4], ids=["tyres-at-once", "tyres-late"])
def test_derivatives_are_those_of_the_innovations(relaxation):
    data, known, _ = watched()
    theta, step = np.full(len(ORDER), 0.4), 1e-3  # no lag at its bound, but for the relaxation
    theta[ORDER.index("relaxation_length")] = relaxation
    derivatives = differentiate(catalogue(), data, theta, known, EVERY)
    value = lambda at: np.asarray(whiten(known, run_observer(catalogue(), data, at, known).e))
    np.testing.assert_allclose(derivatives.e, value(theta), atol=1e-9)
    off = {}
    for name in VARIED:
        change = step * hidden(**{name: 1.0})
        back = 0.0 if theta @ change == 0 else 1.0
        expected = -(value(theta + change) - value(theta - back * change)) / ((1 + back) * step)  # of the prediction
        J = np.asarray(derivatives.J)[..., ORDER.index(name)]
        assert np.linalg.norm(expected) > 1.0, name  # it shows in the data
        off[name] = np.linalg.norm(J - expected) / np.linalg.norm(expected)
    assert max(off.values()) < 0.01, off


@functools.cache
def with_late_sensors():
    """A model whose sensors may be late, nominal data and gains for it."""
    model, data = universal_car(sedan(), effects_by_name(("gyro_bias", "channel_delay"))), watched()[0]
    return model, observer_gains(model, data, np.zeros(4), truth().as_vector())


def test_whole_samples_of_delay_are_a_shift_of_the_data():
    (model, known), late = with_late_sensors(), 3
    delayed = [replace(run, r=np.concatenate([np.full(late, np.nan), run.r[:-late]])) for run in nominal_runs()]
    theta = np.array([0.0, 0.0, 0.0, (late + 1e-9) * DT]) / np.asarray(model.scale)
    data = pieces(sedan(), tuple(delayed))
    late_path, path = run_observer(model, data, theta, known), run_observer(model, watched()[0], np.zeros(4), known)
    np.testing.assert_array_equal(late_path.valid[:, : ROWS - late], path.valid[:, : ROWS - late])
    np.testing.assert_allclose(late_path.e[:, : ROWS - late], path.e[:, : ROWS - late], atol=1e-8)
    assert not late_path.valid[:, ROWS - late :, 2].any()


def test_derivatives_where_sensors_are_late():
    model, known = with_late_sensors()
    theta, step = np.array([0.5, *np.array([0.004, 0.017, 0.035]) / np.asarray(model.scale)[1:]]), 1e-3
    data = watched()[0]
    value = lambda at: np.asarray(whiten(known, run_observer(model, data, at, known).e))
    J = np.asarray(differentiate(model, data, theta, known, np.ones(4, bool)).J)
    for k, change in enumerate(step * np.eye(4)):
        expected = -(value(theta + change) - value(theta - change)) / (2 * step)
        assert np.linalg.norm(J[..., k] - expected) < 0.05 * np.linalg.norm(expected), k


def test_a_run_that_ends_in_a_stop_is_followed_to_its_end():
    still = np.zeros(ROWS)
    V = np.maximum(20 * np.clip(np.linspace(1.3, 0, ROWS), 0, 1), 0.3)
    braking = np.where(V > 0.3, -7000.0, 0.0)
    run = replace(nominal_runs()[0], V=V, beta=still, r=still, delta=still, Fxr=braking, extra={})
    data = pieces(sedan(), (run,))
    known = observer_gains(catalogue(), data, NEUTRAL, truth().as_vector())
    derivatives = differentiate(catalogue(), data, NEUTRAL, known, EVERY)
    assert np.isfinite(known.L).all() and np.isfinite(derivatives.e).all() and np.isfinite(derivatives.J).all()
    assert not np.asarray(derivatives.e)[:, ROWS:].any() and not np.asarray(derivatives.J)[:, ROWS:].any()


def test_noise_is_found_from_the_data():
    noise = build_problem(sedan(), EFFECTS, nominal_runs()).noise
    np.testing.assert_allclose(noise.sigma, truth().sigma, rtol=0.15)
    np.testing.assert_allclose(noise.disturbance, truth().disturbance, rtol=0.5)
    assert 0.5 < noise.correlation / truth().correlation < 2
    assert np.all(noise.slow < 0.01 * truth().sigma)  # there is none


@pytest.mark.parametrize("car", ["sedan", "rc"])
def test_slow_sensor_errors_are_estimated_and_leave_white_innovations(car):
    known = with_slow_errors(truth(car))
    problem = build_problem(nominal_car(car), EFFECTS, recorded(hidden(), 1, 2, car=car, slow=True))
    # the yaw of the RC car settles within a sample: a disturbance of its rate looks much like an error of the gyroscope
    np.testing.assert_allclose(problem.noise.slow, known.slow, rtol=0.35 if car == "sedan" else 0.5)
    np.testing.assert_allclose(problem.noise.sigma, known.sigma, rtol=0.15)
    assert 0.5 < problem.noise.slow_correlation / known.slow_correlation < 2

    def correlation(noise):
        gains = with_noise(problem, problem.start, noise).gains
        e = np.asarray(whiten(gains, run_observer(problem.model, problem.data, NEUTRAL, gains).e))[:, SKIP:ROWS]
        return max(np.abs((e[:, lag:] * e[:, :-lag]).mean(axis=(0, 1)) / (e**2).mean(axis=(0, 1))).max()
                   for lag in (1, 2, 5))  # fmt: skip

    assert correlation(problem.noise) < 0.08
    assert correlation(problem.noise._replace(slow=np.zeros(3))) > 0.2  # the same errors taken for motion of the car


def test_noise_has_the_likelihood_that_scipy_finds():
    data = pieces(sedan(), recorded(hidden(), 1, 2, slow=True)[:3])
    fixed, start = fixed_gain(data), initial_noise(data)
    path = run_observer(catalogue(), data, NEUTRAL, fixed)
    steps = step_derivatives(catalogue(), data, NEUTRAL, path, EVERY)
    ours = estimate_noise(steps, path.e, fixed, start, data.dt, data.informative)
    scale, informative = search_scale(start), jnp.asarray(data.informative[:ROWS])
    steps, e, L = jax.tree.map(lambda a: a[:, :ROWS], (steps, path.e, fixed.L))  # the rest is padding
    cost = lambda x: restricted_likelihood(scale.noise(x), steps, e, L, data.dt, informative)[0]
    slope = jax.jit(jax.value_and_grad(cost))
    scaled = lambda x: tuple(map(np.asarray, slope(jnp.asarray(x))))
    bounds = noise_bounds(start, np.ones(3, bool), np.ones(3, bool), data.dt)
    box = np.stack([scale.variables(jnp.asarray(one.as_vector())) for one in bounds], axis=1)
    options = {"ftol": 1e-12, "gtol": 1e-2}
    other = minimize(scaled, np.zeros(11), jac=True, method="L-BFGS-B", bounds=box, options=options)
    at = np.asarray(scale.variables(jnp.asarray(ours.as_vector())))
    assert abs(scaled(at)[0] - other.fun) < 0.01  # twice the log-likelihood, of 5400 measurements
    np.testing.assert_allclose(at, other.x, atol=0.05)
    h = 0.02 * np.eye(11)[:3]
    curvature = [(scaled(at + one)[1] - scaled(at - one)[1]) @ one / (2 * 0.02**2) for one in h]
    H = information_of_noise(jnp.asarray(at), scale, steps, e, L, data.dt, informative)
    np.testing.assert_allclose(2 * np.diag(H)[:3], curvature, rtol=0.1)


def test_long_runs_are_cut_and_the_rest_is_padding():
    run, rng = nominal_runs()[0], np.random.default_rng(4)
    n = 1700
    long = replace(run, t=np.arange(n) * DT, delta=rng.normal(size=n), Fxr=rng.normal(size=n),
                   V=10 + rng.normal(size=n), beta=rng.normal(size=n), r=rng.normal(size=n), extra={})  # fmt: skip
    data = pieces(sedan(), (long, run))
    assert list(data.run) == [0, 0, 1] and data.block.shape == (3, PIECE_LENGTH)
    valid, lead = np.asarray(data.padded.valid), data.padded.commands.shape[1] - PIECE_LENGTH
    assert lead == round(1.0 / DT)
    assert valid[0].all() and valid[1, :700].all() and not valid[1, 700:].any()
    assert valid[2, :ROWS].all() and not valid[2, ROWS:].any()
    np.testing.assert_array_equal(data.padded.y[1][:700, 1], long.beta[PIECE_LENGTH:])
    assert not np.asarray(data.padded.y[1])[700:].any()
    np.testing.assert_array_equal(data.padded.commands[1][: lead + 700, 0], long.delta[PIECE_LENGTH - lead :])
    np.testing.assert_array_equal(data.padded.commands[0][:lead, 0], np.full(lead, long.delta[0]))
    np.testing.assert_allclose(data.padded.place.t[1][:700], long.t[PIECE_LENGTH:])


def test_many_short_runs_are_followed_in_short_pieces():
    run = nominal_runs()[0]
    cut = lambda n: replace(run, **{k: getattr(run, k)[:n] for k in ("t", "V", "beta", "r", "delta", "Fxr")}, extra={})
    assert pieces(sedan(), (cut(120), cut(240), cut(600))).block.shape == (5, 250)
    assert pieces(sedan(), (cut(600), cut(500))).block.shape == (2, PIECE_LENGTH)
    assert pieces(sedan(), (cut(500), cut(500), cut(550))).block.shape == (7, SHORT_PIECE_LENGTH)  # 58 % of the samples


def test_blocks_go_on_from_piece_to_piece_and_not_from_run_to_run():
    run = nominal_runs()[0]
    n = 1700
    grow = lambda values: np.resize(values, n)
    columns = {name: grow(getattr(run, name)) for name in ("V", "beta", "r", "delta", "Fxr")}
    data = pieces(sedan(), (replace(run, t=np.arange(n) * DT, extra={}, **columns), run))
    seconds = np.arange(PIECE_LENGTH) * DT
    assert data.num_blocks == data.block.max() + 1
    for block, length in ((data.block, BLOCK), (error_blocks(data), ERROR_BLOCK)):
        for row, since in ((0, 0), (1, 10)):
            expected = (np.minimum(seconds + since + 1e-9, (n - 1) * DT) // length).astype(int)  # no padding alone
            assert (block[row] != expected).mean() < 0.02  # rounding may move a border by a sample
        assert block[0].max() < block[2].min() and block[1].max() < block[2].min()
        assert block.max() + 1 == math.ceil(n * DT / length) + math.ceil(ROWS * DT / length)
