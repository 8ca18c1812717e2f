"""Kinematic parity: zero on exact kinematics, a biased sensor distinguished from the car, gaps, missing columns."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis.recorded import hidden, recorded, sedan, truth

from driftjax.diagnosis.parity import WINDOW, parity
from driftjax.logs import Run

DT, NUM = 0.01, 2000
SIGMA = np.array([0.05, 0.0087, 0.0087])


def exact(seed: int = 0) -> Run:
    """A motion without noise: V, beta and r are given, and the accelerations follow."""
    t, phase = np.arange(NUM) * DT, np.random.default_rng(seed).uniform(0, 6, 3)
    V, dV = 12 + 2 * np.sin(0.9 * t + phase[0]), 1.8 * np.cos(0.9 * t + phase[0])
    beta, dbeta = 0.5 * np.sin(0.7 * t + phase[1]), 0.35 * np.cos(0.7 * t + phase[1])
    r = 0.6 * np.cos(0.8 * t + phase[2])
    turn = V * (dbeta + r)
    ax, ay = dV * np.cos(beta) - turn * np.sin(beta), dV * np.sin(beta) + turn * np.cos(beta)
    zero = np.zeros(NUM)
    return Run(f"run{seed}", t, V, beta, r, zero, zero, DT, {"ax": ax, "ay": ay})


def noisy(run: Run, seed: int) -> Run:
    rng = np.random.default_rng([seed, 9])
    V, beta, r = np.stack([run.V, run.beta, run.r]) + SIGMA[:, None] * rng.standard_normal((3, NUM))
    extra = {name: values + 0.05 * rng.standard_normal(NUM) for name, values in run.extra.items()}
    return replace(run, V=V, beta=beta, r=r, extra=extra)


def test_exact_kinematics_leave_nothing():
    result = parity(sedan(), [exact(0), exact(1)], SIGMA)
    assert result is not None
    assert np.abs(result.mean).max() < 1e-4 and (result.rms < 1e-3).all()
    assert result.num == 2 * ((NUM - 1) // round(WINDOW / DT))


def test_noise_alone_is_reported_as_noise():
    for seed in range(5):
        result = parity(sedan(), [noisy(exact(2 * seed + k), seed + 10 * k) for k in range(2)], SIGMA)
        assert result is not None and "agree within noise" in result.statement
        np.testing.assert_allclose(result.rms / result.floor, 1.0, atol=0.2)
        np.testing.assert_allclose(result.excess, 1.0, atol=0.5)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.05, 0.1])
def test_noise_alone_is_noise_whatever_share_of_samples_is_missing(share):
    """Where windows are left out, a block holds the noise at the ends of several stretches."""
    results, rng = [], np.random.default_rng(5)
    for seed in range(6):
        runs = [noisy(exact(2 * seed + k), seed + 10 * k) for k in range(4)]
        gone = [np.isin(np.arange(NUM) // 5, np.flatnonzero(rng.random(NUM // 5) < share)) for _ in runs]
        gappy = [replace(run, V=np.where(lost, np.nan, run.V)) for run, lost in zip(runs, gone, strict=True)]
        results.append(parity(sedan(), gappy, SIGMA))
    assert all("agree within noise" in one.statement for one in results)
    np.testing.assert_allclose(np.sqrt(np.mean([one.excess**2 for one in results], axis=0)), 1.0, atol=0.12)


@pytest.mark.parametrize("bias", [0.02, -0.02])
def test_a_biased_gyro_shows_in_the_sideslips_rate_by_as_much(bias):
    runs = [noisy(exact(k), k) for k in range(2)]
    result = parity(sedan(), [replace(run, r=run.r + bias) for run in runs], SIGMA)
    assert result is not None
    assert result.mean[1] == pytest.approx(bias, abs=0.003) and abs(result.z[1]) > 4 > abs(result.z[0])
    assert "beta' is off by" in result.statement and "a sensor or the road" in result.statement


def test_an_error_without_a_mean_shows_too():
    runs = [noisy(exact(k), k) for k in range(2)]
    wave = 0.5 * np.sin(2 * np.pi * np.arange(NUM) * DT / 10)  # a slope felt while the car turns round
    result = parity(sedan(), [replace(run, extra=run.extra | {"ay": run.extra["ay"] + wave}) for run in runs], SIGMA)
    assert result is not None and result.excess[1] > 1.5 and "errs by" in result.statement


def test_gaps_are_left_out_and_missing_columns_reported():
    run = noisy(exact(0), 0)
    V = run.V.copy()
    V[500:560] = np.nan
    complete, gappy = parity(sedan(), [run], SIGMA), parity(sedan(), [replace(run, V=V)], SIGMA)
    assert complete is not None and gappy is not None
    assert complete.num - 4 <= gappy.num < complete.num and np.isfinite(gappy.mean).all()
    assert parity(sedan(), [run, replace(run, extra={"ax": run.extra["ax"]})], SIGMA) is None
    assert parity(sedan(), [replace(run, V=np.full(NUM, np.nan))], SIGMA) is None
    assert parity(sedan(), [replace(run, V=0.1 + 0 * run.V)], SIGMA) is None  # too slow for a sideslip


@pytest.mark.parametrize(("name", "size", "is_sensor"), [("friction_rear", -2.0, False), ("gyro_bias", 2.0, True)])
def test_recordings_tell_sensors_from_physics(name, size, is_sensor):
    result = parity(sedan(), recorded(hidden(**{name: size}), 3, 4), truth().sigma)
    assert result is not None and ("a sensor or the road" in result.statement) == is_sensor
