"""Sensors: moments of the noise, its key, and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.sim.sensors import (
    Measurement,
    SensorConfig,
    first_slow_errors,
    load_sensors,
    measure,
    next_slow_errors,
)
from driftjax.vehicle import Motion

NUM = 20_000


def motion(num):
    fields = {name: jnp.full(num, 0.1 * place) for place, name in enumerate(Motion._fields)}
    return Motion(**fields)


@pytest.mark.parametrize("car", ["sedan", "rc"])
def test_noise_has_the_configured_deviation_and_no_bias(car):
    config = load_sensors(car)
    got = measure(motion(NUM), config, key=jax.random.key(0))
    for name in Measurement._fields:
        sigma = getattr(config, f"sigma_{name}")
        error = np.asarray(getattr(got, name) - getattr(motion(NUM), name))
        assert abs(error.mean()) < 4 * sigma / np.sqrt(NUM)
        np.testing.assert_allclose(error.std(), sigma, rtol=4 / np.sqrt(2 * NUM))


def test_channels_are_independent():
    got = np.stack(measure(motion(NUM), load_sensors("sedan"), key=jax.random.key(1)))
    assert np.abs(np.corrcoef(got) - np.eye(6)).max() < 5 / np.sqrt(NUM)


def test_key_decides_the_noise_and_silence_is_the_truth():
    config, one = load_sensors("rc"), motion(3)
    first, again, other = (measure(one, config, key=jax.random.key(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.all(np.asarray(first) != np.asarray(other))
    silent = measure(one, SensorConfig(), key=jax.random.key(0))
    np.testing.assert_array_equal(silent, (one.V, one.beta, one.r, one.x, one.y, one.psi))


def test_negative_deviation_and_unknown_sensors_are_refused():
    with pytest.raises(BadInput, match="sigma_r"):
        SensorConfig(sigma_r=-1.0)
    with pytest.raises(BadInput, match="sedan"):
        load_sensors("radar")


def test_slow_errors_are_stationary_with_the_configured_deviation_and_correlation():
    config, dt = load_sensors("rc_field"), jnp.asarray(0.1)
    keys = jax.random.split(jax.random.key(2), 2 * NUM).reshape(2, NUM)
    first = jax.vmap(lambda key: first_slow_errors(config, key=key))(keys[0])
    later = jax.vmap(lambda c, key: next_slow_errors(config, c, dt, key=key))(first, keys[1])
    for values in (first, later):
        np.testing.assert_allclose(np.std(np.asarray(values), axis=0), config.of_channels("slow"), rtol=0.03)
    kept = np.mean(np.asarray(first * later), axis=0) / config.of_channels("slow") ** 2
    np.testing.assert_allclose(kept, np.exp(-0.1 / config.slow_time), atol=0.03)


def test_bias_and_slow_errors_add_to_the_reading():
    one, slow = motion(1), jnp.arange(1.0, 7.0)[:, None]
    got = measure(one, SensorConfig(bias_beta=0.01), key=jax.random.key(0), slow=slow)
    biased = (one.V, one.beta + 0.01, one.r, one.x, one.y, one.psi)
    np.testing.assert_allclose(np.stack(got), np.stack(biased) + slow, rtol=1e-12)
