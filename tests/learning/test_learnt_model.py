"""The learnt residual: a planted one gets a high trust factor, noise does not, and no data means no residual."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.learning.config import GPConfig
from driftjax.learning.model import FOLDS, empty, trust_factors, update_model

LAGS = jnp.asarray([0.05, 0.1])
at = eqx.filter_jit(lambda residual, Z: jax.vmap(residual)(Z))
CONFIG = GPConfig(size=80, num_fit=60, restarts=1)
MEAN, SPREAD = np.array([9.0, -0.5, 1.1, -0.3, 6000.0]), np.array([0.8, 0.1, 0.2, 0.1, 800.0])
SIZE = np.array([0.5, 0.2, 0.4])
fitted: Any = eqx.filter_jit(
    lambda model_state, Z, Y, mask, key: update_model(model_state, Z, Y, mask, LAGS, CONFIG, key)
)


def planted(W):
    """Smooth in the inputs over their standard deviations `W` (M, 5); of the magnitudes `SIZE`."""
    return SIZE * np.stack([np.sin(W[:, 0]), 0.7 * W[:, 1], np.cos(0.5 * W[:, 2]) + 0.5 * W[:, 0]], axis=1)


def data(noise: float, signal: float, num: int = 160) -> Any:
    rng = np.random.default_rng(0)
    W = rng.normal(size=(num, 5))
    Y = signal * planted(W) + noise * SIZE * rng.normal(size=(num, 3))
    return MEAN + SPREAD * W, Y, np.ones(num, bool)


@pytest.fixture(scope="module")
def good():
    return fitted(empty(CONFIG), *data(noise=0.1, signal=1.0), jax.random.key(0))


def test_a_planted_residual_is_learnt_and_trusted(good):
    assert np.all(np.asarray(good.residual.trust_factor) > 0.7)
    W = 0.7 * np.random.default_rng(1).normal(size=(30, 5))
    error = np.asarray(at(good.residual, MEAN + SPREAD * W)) - planted(W)
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 0.5 * SIZE)


def test_pure_noise_is_switched_off():
    Z, Y, mask = data(noise=1.0, signal=0.0)
    model = fitted(empty(CONFIG), Z, Y, mask, jax.random.key(0))
    assert np.all(np.std(at(model.residual, Z), axis=0) < 0.2 * SIZE)


def test_rows_that_are_no_data_change_nothing_and_few_rows_teach_nothing():
    Z, Y, _ = data(noise=0.1, signal=1.0)
    few = np.arange(len(Z)) < 15
    model = fitted(empty(CONFIG), Z, Y, few, jax.random.key(0))
    assert np.sum(model.mask) == 15
    assert not np.any(model.residual.trust_factor) and not np.any(at(model.residual, Z))


def test_the_memory_keeps_its_size_and_the_data_of_earlier_laps(good):
    Z, Y, mask = data(noise=0.1, signal=1.0)
    again = fitted(good, Z, Y, np.zeros_like(mask), jax.random.key(1))
    assert again.Z.shape == good.Z.shape == (CONFIG.size, 5)
    kept = {tuple(z) for z in np.asarray(good.Z)[np.asarray(good.mask)]}
    assert {tuple(z) for z in np.asarray(again.Z)[np.asarray(again.mask)]} == kept


def test_without_a_lap_there_is_no_residual():
    nothing = empty(CONFIG)
    assert not np.any(nothing.mask)
    assert not np.any(at(nothing.residual, MEAN[None]))


def test_noise_of_the_data_does_not_lower_the_gate():
    """Explained variance would be: no mean explains the noise in its targets."""
    Z, Y, mask = data(noise=0.75, signal=1.0, num=400)
    model = fitted(empty(CONFIG), Z, Y, mask, jax.random.key(0))
    explained = 1 - (0.75 * SIZE) ** 2 / np.mean(np.asarray(Y) ** 2, axis=0)
    assert np.all(explained < 0.65) and np.all(np.asarray(model.residual.trust_factor) > explained + 0.1)


def test_a_mean_that_says_the_opposite_is_switched_off_whatever_the_order_of_the_rows():
    Z, Y, mask = data(noise=0.05, signal=1.0)
    gp = fitted(empty(CONFIG), Z, Y, mask, jax.random.key(0)).residual.gp
    trust_factor = eqx.filter_jit(lambda Z, Y, order: trust_factors(gp, Z, Y, mask, order, CONFIG))
    order = np.arange(len(mask))
    turns = ((-1.0) ** (np.arange(len(mask)) * FOLDS // len(mask)))[:, None]
    assert np.all(np.asarray(trust_factor(Z, Y, order)) > 0.7)
    assert not np.any(trust_factor(Z, Y * turns, order))  # of the three other stretches two say the opposite
    mixed = np.asarray(jax.random.permutation(jax.random.key(0), len(mask)))
    assert not np.any(trust_factor(Z[mixed], (Y * turns)[mixed], order[mixed]))


def wandering(seed: int, num: int = 160):
    """Inputs along a smooth path, and targets that are coloured noise along it: nothing to learn."""
    rng = np.random.default_rng(seed)
    smooth = lambda: np.stack([np.convolve(one, np.ones(30) / 30**0.5, "valid")
                               for one in rng.normal(size=(5, num + 29))], axis=1)  # fmt: skip
    return MEAN + SPREAD * smooth(), SIZE * smooth()[:, :3]


def test_what_neighbours_in_time_share_earns_little_trust():
    """Rows amid others of the same second are foretold as well as by a mean that is right: held out in blocks of ten,
    every second one, these earn 0.78 on average."""
    Z, Y = wandering(0)
    mask, order = map(jnp.asarray, (np.ones(len(Z), bool), np.arange(len(Z))))
    gp = fitted(empty(CONFIG), Z, Y, mask, jax.random.key(0)).residual.gp
    trust_factor = eqx.filter_jit(lambda Z, Y: trust_factors(gp, Z, Y, mask, order, CONFIG))
    assert np.mean([trust_factor(*wandering(seed)) for seed in range(20)]) < 0.45


def test_the_memory_knows_when_its_rows_were_driven(good):
    Z, Y, mask = data(noise=0.1, signal=1.0)
    later = fitted(good, Z + SPREAD, Y, mask, jax.random.key(1))
    place = {tuple(z): i for i, z in enumerate(np.concatenate([Z, Z + SPREAD]))}
    kept, order = (np.asarray(a)[np.asarray(later.mask)] for a in (later.Z, later.order))
    at = np.array([place[tuple(z)] for z in kept])
    assert np.all(np.diff(order[np.argsort(at)]) >= 1)
    new = at >= len(Z)
    assert 0 < np.sum(new) < len(new) and np.min(order[new]) > np.max(order[~new]) + FOLDS
