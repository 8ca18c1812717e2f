"""Sensors: moments of the noise, its key, and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.sim.sensors import Measurement, SensorConfig, load_sensors, measure
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
