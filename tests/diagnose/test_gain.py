"""Open-loop gain: errors against hand-made ones, skill and its interval, runs held out, verdict sentences."""

import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.diagnose.diagnosis import split
from driftjax.diagnose.gain import Errors, skill
from driftjax.diagnose.observer import expected, riccati, transition

SIGMA = np.array([0.05, 0.01, 0.01])
FLOOR = Errors(np.broadcast_to(SIGMA**2, (200, 2, 3)), (0.01, 1.0), np.arange(200) // 4)


def errors(size: float, num: int = 200, seed: int = 0) -> Errors:
    """Squared errors of noise plus a model error of `size` noises in every channel."""
    rng = np.random.default_rng(seed)
    draws = rng.standard_normal((num, 2, 3)) * SIGMA + size * SIGMA
    return Errors(draws**2, (0.01, 1.0), np.arange(num) // 4)


def test_rmse_is_the_root_of_the_mean_over_what_was_measured():
    one = errors(3.0)
    one.squares[:50] = np.nan
    np.testing.assert_allclose(one.rms, np.sqrt(np.mean(one.squares[50:], axis=0)))


def test_skill_is_one_for_a_model_at_the_noise_floor_and_zero_for_no_change():
    nominal, mended = errors(5.0), errors(0.0, seed=1)
    value, (low, high) = skill(nominal, mended, FLOOR)
    assert value == pytest.approx(1.0, abs=0.03) and low < value < high
    value, (low, high) = skill(nominal, nominal, FLOOR)
    assert value == pytest.approx(0.0, abs=1e-12) and low == high == pytest.approx(0.0, abs=1e-9)


def test_skill_is_negative_where_a_model_is_worse_and_a_random_change_shows_no_gain():
    assert skill(errors(2.0), errors(3.0, seed=1), FLOOR)[0] < -0.5
    found = [skill(errors(2.0, seed=k), errors(2.0, seed=k + 100), FLOOR) for k in range(40)]
    assert sum(low < 0 < high for _, (low, high) in found) >= 34
    assert np.abs([value for value, _ in found]).max() < 0.35


def test_no_share_is_told_where_noise_explains_everything():
    value, interval = skill(errors(0.0), errors(1.0, seed=1), FLOOR)
    assert np.isnan([value, *interval]).all()


def test_every_third_run_is_held_out_and_none_of_too_few():
    use, held = split(7, 3)
    assert list(held) == [2, 5] and list(use) == [0, 1, 3, 4, 6]
    for num, every in ((2, 3), (7, 0)):
        use, held = split(num, every)
        assert list(use) == list(range(num)) and not len(held)


def test_the_floor_is_what_noise_makes_of_a_true_model():
    """A linear car with disturbed rates, followed and predicted many times over."""
    rng, dt, T, num, start, many = np.random.default_rng(3), 0.02, 60, 30, 25, 4000
    noise = np.array([*SIGMA, 0.3, 0.1, 0.4, 0.2])
    left, A = np.exp(-dt / noise[6]), np.eye(3) + dt * np.array([[-0.2, 1, 0], [0, 1.5, -1], [0.3, 2, 0.5]])
    A_all, seen = jnp.broadcast_to(jnp.asarray(A), (T, 3, 3)), jnp.ones((T, 3))
    gains = riccati(A_all, seen, jnp.asarray(noise[:3]), jnp.asarray(noise[3:6]), jnp.asarray(left), dt)
    F = np.asarray(transition(jnp.asarray(A), jnp.asarray(left), dt))
    told = 2 * SIGMA * rng.standard_normal((many, 3))
    w = np.concatenate([told, noise[3:6] * rng.standard_normal((many, 3))], axis=1)
    known, errors = np.zeros((many, 6)), []
    for k in range(start + num + 1):
        y = w[:, :3] + SIGMA * rng.standard_normal((many, 3))
        if k <= start:
            known = known + (y - known[:, :3]) @ np.asarray(gains.L[k]).T
            known = np.concatenate([known[:, :3], 0 * known[:, 3:]], axis=1) if k == start else known
        else:
            errors.append(((known[:, :3] - y) ** 2).mean(axis=0))
        kick = np.sqrt(1 - left**2) * noise[3:6] * rng.standard_normal((many, 3))
        w, known = w @ F.T + np.concatenate([np.zeros((many, 3)), kick], axis=1), known @ F.T
    found = expected(A_all, gains.P, jnp.asarray(noise), jnp.array([start]), num, dt)[0]
    np.testing.assert_allclose(np.asarray(found), np.array(errors), rtol=0.12)
    assert (np.diff(np.asarray(found), axis=0) > 0).all()
