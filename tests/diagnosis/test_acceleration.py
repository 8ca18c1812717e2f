"""Rate of a measured speed: against dense Gaussian regression, its error against its estimate, and as a force."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, sedan
from numpy.typing import NDArray

from driftjax.core import State
from driftjax.diagnosis.acceleration import filter_speed, smooth_speed, smooth_speeds
from driftjax.logs.agreement import smooth_with_rate
from driftjax.sim.rollout import begin, move
from driftjax.sim.sensitivity import move_with_derivatives
from driftjax.vehicle.effect import Place
from driftjax.vehicle.single_track import G
from driftjax.vehicle.universal import universal_car

DT = 0.02
SIZES = np.array([0.05, 1.5])  # noise of the speed, growth of the rate's walk


def covariance(num: int) -> NDArray:
    """Prior covariance of a speed, the integral of a random walk, at the first `num` samples."""
    t = DT * np.arange(num)
    first, last = np.minimum(t[:, None], t), np.maximum(t[:, None], t)
    walk = SIZES[1] ** 2 * first**2 * (3 * last - first) / 6  # Wahba 1978, Eq. 1.4
    return (2 * SIZES[0]) ** 2 + G**2 * t[:, None] * t + walk


def test_filter_and_smoother_agree_with_dense_gaussian_regression():
    num, rng = 40, np.random.default_rng(0)
    prior, valid = covariance(num), rng.random(num) < 0.8
    valid[0] = True
    S = prior + SIZES[0] ** 2 * np.eye(num)
    V = np.linalg.cholesky(S) @ rng.standard_normal(num)
    V -= V[0]  # the first speed is the one expected at the start
    S, e = S[np.ix_(valid, valid)], V[valid]
    cost = e @ np.linalg.solve(S, e) + np.linalg.slogdet(S)[1]
    inputs = jnp.asarray(SIZES), jnp.asarray(np.where(valid, V, 0.0)), jnp.asarray(valid, float), DT
    assert filter_speed(*inputs)[0] == pytest.approx(cost, rel=1e-9)
    np.testing.assert_allclose(smooth_speed(*inputs), prior[:, valid] @ np.linalg.solve(S, e), atol=1e-9)


@cache
def driven(num: int = 3000) -> tuple[NDArray, NDArray]:
    """Mean rate of a speed over each step, and the measured speed, some of which is missing."""
    rng = np.random.default_rng(1)
    walk = np.cumsum(SIZES[1] * np.sqrt(DT) * rng.standard_normal(num))
    rate = walk - smooth_with_rate(walk, DT, 10.0)[0]
    V = 20 + np.cumsum(np.append(0.0, rate[:-1])) * DT + SIZES[0] * rng.standard_normal(num)
    V[rng.random(num) < 0.05] = np.nan
    V[900:950] = np.nan
    return rate, V


def rate_of(V: NDArray) -> NDArray:
    """Mean rate over the step after each sample."""
    return np.diff(V, append=2 * V[-1] - V[-2]) / DT


def test_the_error_of_the_estimate_does_not_depend_on_it():
    """A slope of the true rate over the estimate of 1: forces are not weakened, as they are by a derivative's noise."""
    rate, V = driven()
    estimate = rate_of(smooth_speeds([V], DT)[0])
    inner = np.isfinite(filtered := smooth_with_rate(V, DT, 0.1)[1])
    inner[:50] = inner[-50:] = False
    slope = lambda x: np.polyfit(x[inner], rate[inner], 1)[0]
    assert slope(estimate) == pytest.approx(1.0, abs=0.04)
    assert slope(filtered) < 0.7
    assert (estimate - rate)[inner].std() < 0.3 * rate.std()
    assert np.isfinite(estimate).all()


def test_runs_of_other_lengths_share_the_sizes_and_keep_their_own_rates():
    rate, V = driven()
    speeds = smooth_speeds([V, V[:1000]], DT)
    assert [len(one) for one in speeds] == [3000, 1000]
    both = [rate_of(speed) for speed in speeds]
    np.testing.assert_allclose(both[1][:900], both[0][:900], atol=0.02 * rate.std())


def test_a_disturbance_of_the_speed_is_an_error_of_the_force():
    """Of a car whose force follows from the rate of its speed: sideslip and yaw rate feel it too."""
    car = universal_car(sedan(), EFFECTS, by_acceleration=True)
    u, place, dt = jnp.array([0.05, 1500.0, 0.0, 0.0]), Place(*jnp.zeros(4)), jnp.asarray(0.02)
    z = begin(car, jnp.array([15.0, -0.35, 0.5]), u, place)
    push = jnp.array([0.2, 0.0, 0.0])
    more = u.at[1].add(car.base.m * push[0])
    np.testing.assert_allclose(move(car, z, u, place, dt, State(*push)).z, move(car, z, more, place, dt).z, rtol=1e-12)
    by = move_with_derivatives(car, z, u, place, dt, jnp.zeros(3)).by
    np.testing.assert_allclose(by[:, 10], car.base.m * by[:, 7], rtol=1e-9, atol=1e-15)
    assert abs(by[1, 10] * 15.0) > 0.1 * dt
    measured = universal_car(sedan(), EFFECTS)
    apart = move_with_derivatives(measured, z, u, place, dt, jnp.zeros(3)).by[:, 10]
    assert apart[0] == pytest.approx(0.02, rel=0.01) and abs(apart[1]) < 0.1 * abs(by[1, 10])
