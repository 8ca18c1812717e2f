"""The learnt residual: a planted one passes the gate, noise does not, and no data means no residual."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.learn.config import GPConfig
from driftjax.learn.model import empty, learn

LAGS = jnp.asarray([0.05, 0.1])
CONFIG = GPConfig(size=80, num_fit=60, restarts=1)
MEAN, SPREAD = np.array([9.0, -0.5, 1.1, -0.3, 6000.0]), np.array([0.8, 0.1, 0.2, 0.1, 800.0])
SIZE = np.array([0.5, 0.2, 0.4])
fitted = eqx.filter_jit(lambda memory, Z, Y, mask, key: learn(memory, Z, Y, mask, LAGS, CONFIG, key))


def planted(W):
    """Smooth in the inputs over their standard deviations `W` (M, 5); of the magnitudes `SIZE`."""
    return SIZE * np.stack([np.sin(W[:, 0]), 0.7 * W[:, 1], np.cos(0.5 * W[:, 2]) + 0.5 * W[:, 0]], axis=1)


def data(noise: float, signal: float, num: int = 160):
    rng = np.random.default_rng(0)
    W = rng.normal(size=(num, 5))
    Y = signal * planted(W) + noise * SIZE * rng.normal(size=(num, 3))
    return jnp.asarray(MEAN + SPREAD * W), jnp.asarray(Y), jnp.ones(num, bool)


@pytest.fixture(scope="module")
def good():
    return fitted(empty(CONFIG), *data(noise=0.1, signal=1.0), jax.random.key(0))


def test_a_planted_residual_is_learnt_and_trusted(good):
    assert np.all(np.asarray(good.held_out) < 0.5)
    assert np.all(np.asarray(good.residual.gate) > 0.7)
    gained, noise = 1 - np.square(good.held_out), np.exp(2 * np.asarray(good.residual.gp.hyper.log_noise))
    np.testing.assert_allclose(good.residual.gate, np.minimum(gained / (1 - noise), 1), rtol=1e-9)
    W = 0.7 * np.random.default_rng(1).normal(size=(30, 5))
    error = np.asarray(jax.vmap(good.residual)(jnp.asarray(MEAN + SPREAD * W))) - planted(W)
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 0.5 * SIZE)


def test_pure_noise_is_switched_off():
    found = fitted(empty(CONFIG), *data(noise=1.0, signal=0.0), jax.random.key(0))
    assert np.all(np.asarray(found.residual.gate) < 0.3)
    assert np.all(np.asarray(found.held_out) > 0.8)


def test_rows_that_are_no_data_change_nothing_and_few_rows_teach_nothing():
    Z, Y, _ = data(noise=0.1, signal=1.0)
    few = jnp.arange(len(Z)) < 15
    found = fitted(empty(CONFIG), Z, Y, few, jax.random.key(0))
    assert int(jnp.sum(found.mask)) == 15
    assert bool(jnp.all(found.residual.gate == 0)) and bool(jnp.all(found.residual(Z[0]) == 0))


def test_the_memory_keeps_its_size_and_the_data_of_earlier_laps(good):
    Z, Y, mask = data(noise=0.1, signal=1.0)
    again = fitted(good, Z, Y, jnp.zeros_like(mask), jax.random.key(1))
    assert again.Z.shape == good.Z.shape == (CONFIG.size, 5)
    kept = {tuple(z) for z in np.asarray(good.Z[good.mask])}
    assert {tuple(z) for z in np.asarray(again.Z[again.mask])} == kept


def test_without_a_lap_there_is_no_residual():
    nothing = empty(CONFIG)
    assert not bool(jnp.any(nothing.mask)) and bool(jnp.all(nothing.held_out == 1))
    assert bool(jnp.all(nothing.residual(jnp.asarray(MEAN)) == 0))


def test_the_gate_tells_the_quality_of_the_mean_whatever_the_noise_of_the_data():
    Z, Y, mask = data(noise=0.75, signal=1.0, num=400)
    found = fitted(empty(CONFIG), Z, Y, mask, jax.random.key(0))
    right = planted((np.asarray(Z) - MEAN) / SPREAD)
    error = np.asarray(jax.vmap(found.residual.gp.bounded_mean)(Z)) - right
    quality = 1 - np.mean(error**2, axis=0) / np.mean(right**2, axis=0)  # with all rows: a little above held-out rows'
    of_noisy_targets = 1 - np.square(found.held_out)
    gate = np.asarray(found.residual.gate)
    assert np.all(of_noisy_targets < quality - 0.2)
    assert np.all(gate > of_noisy_targets + 0.05) and np.all(gate < quality + 0.05)
