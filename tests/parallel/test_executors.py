"""Lanes in blocks: the same values in any blocks and on any workers; zeros in the same shapes when rehearsed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import Blocks, Rehearsal, threads, workers


class Car(eqx.Module):
    mass: jax.Array
    name: str = eqx.field(static=True)


def doubled(lanes, shift, label):
    car, keys = lanes
    return {"mass": 2 * car.mass + shift + jax.vmap(jax.random.normal)(keys), "car": car, "label": label}


def fails(lanes):
    raise ValueError("no such lane")


def some(num: int):
    return Car(jnp.arange(1.0, num + 1), "sedan"), jax.random.split(jax.random.key(0), num)


def test_blocks_of_any_size_and_workers_give_the_same_bits():
    whole = Blocks(None).map(doubled, some(5), jnp.asarray(0.5), "run")
    assert whole["mass"].shape == (5,) and whole["label"] == "run" and whole["car"].name == "sedan"
    with workers(2) as beside:
        for blocks in (Blocks(1), Blocks(2), beside):
            found = blocks.map(doubled, some(5), jnp.asarray(0.5), "run")
            later = blocks.begin(doubled, some(5), jnp.asarray(0.5), "run")
            np.testing.assert_allclose(later()["mass"], whole["mass"], rtol=1e-15)  # not compiled
            np.testing.assert_array_equal(found["mass"], whole["mass"])
            assert found["car"].name == "sedan"
        with pytest.raises(ValueError, match="no such lane"):
            beside.map(fails, some(2))
        with pytest.raises(ValueError, match="no such lane"):
            beside.begin(fails, some(2))()
        assert beside.pool is not None
        dry = Rehearsal(beside.pool).map(doubled, some(3), jnp.asarray(0.5), "run")
        np.testing.assert_array_equal(dry["mass"], np.zeros(3))


@pytest.mark.parametrize("num", [1, 2, 3])
def test_threads_share_the_lanes_and_compile_each_shape_once(num):
    whole = Blocks(None).map(doubled, some(7), jnp.asarray(0.5), "run")
    beside = threads(7, num)
    found = beside.map(doubled, some(7), jnp.asarray(0.5), "run")
    with pytest.raises(ValueError, match="no such lane"):
        beside.map(fails, some(7))
    np.testing.assert_array_equal(found["mass"], whole["mass"])


def test_without_workers_everything_stays_in_this_process():
    with workers(0) as blocks:
        assert blocks.pool is None and blocks.size == 1
