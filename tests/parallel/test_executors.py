"""Executors: the same values in calls of any size and on any workers; zeros of the same shapes when compiled ahead."""

import os
import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.environment import FUSED, FUSED_RESULTS
from driftjax.parallel import BatchExecutor, CompileAheadExecutor, executors, process_executor, thread_executor
from driftjax.parallel.batch import batch_size


class Car(eqx.Module):
    mass: jax.Array
    name: str = eqx.field(static=True)


def doubled(batch, shift, label):
    car, keys = batch
    return {"mass": 2 * car.mass + shift + jax.vmap(jax.random.normal)(keys), "car": car, "label": label}


def fails(batch):
    raise ValueError("no such entry")


def some(num: int):
    return Car(jnp.arange(1.0, num + 1), "sedan"), jax.random.split(jax.random.key(0), num)


def test_calls_of_any_size_and_workers_give_the_same_bits():
    whole = BatchExecutor(None).map(doubled, some(5), jnp.asarray(0.5), "run")
    assert whole["mass"].shape == (5,) and whole["label"] == "run" and whole["car"].name == "sedan"
    with process_executor(2) as workers:
        for executor in (BatchExecutor(1), BatchExecutor(2), workers):
            result = executor.map(doubled, some(5), jnp.asarray(0.5), "run")
            later = executor.submit(doubled, some(5), jnp.asarray(0.5), "run")
            np.testing.assert_allclose(later()["mass"], whole["mass"], rtol=1e-15)  # not compiled
            np.testing.assert_array_equal(result["mass"], whole["mass"])
            assert result["car"].name == "sedan"
        with pytest.raises(ValueError, match="no such entry"):
            workers.map(fails, some(2))
        with pytest.raises(ValueError, match="no such entry"):
            workers.submit(fails, some(2))()
        assert workers.pool is not None
        dry = CompileAheadExecutor(workers.pool).map(doubled, some(3), jnp.asarray(0.5), "run")
        np.testing.assert_array_equal(dry["mass"], np.zeros(3))


@pytest.mark.parametrize("num", [1, 2, 3])
def test_threads_share_a_batch_and_end_with_the_context(num):
    whole = BatchExecutor(None).map(doubled, some(7), jnp.asarray(0.5), "run")
    before = threading.active_count()
    with thread_executor(7, num) as executor:
        result = executor.map(doubled, some(7), jnp.asarray(0.5), "run")
        with pytest.raises(ValueError, match="no such entry"):
            executor.map(fails, some(7))
    assert threading.active_count() == before
    np.testing.assert_array_equal(result["mass"], whole["mass"])


def test_without_workers_everything_stays_in_this_process():
    with process_executor(0) as executor:
        assert executor.pool is None and executor.chunk == 1


@pytest.mark.parametrize("wanted", ["1", "0"])
def test_laps_are_computed_by_workers_whose_kernels_have_several_results(monkeypatch, wanted):
    monkeypatch.setenv(FUSED, wanted)
    with process_executor(0, fused=True) as executor:
        flags = executor.submit(os.getenv, "XLA_FLAGS")() or ""
        assert (executor.pool is not None) == (FUSED_RESULTS in flags.split()) == (wanted == "1")
    assert FUSED_RESULTS not in os.environ["XLA_FLAGS"]


def sizes(batch):
    return jnp.full(batch_size(batch), batch_size(batch)), batch


@pytest.mark.parametrize("num, size", [(1, 1), (3, 2), (16, 8), (19, 10), (32, 16), (33, 9), (300, 15)])
def test_blocks_fill_calls_of_one_size(monkeypatch, num, size):
    monkeypatch.setattr(executors, "num_cores", lambda: 2)
    numbers = jnp.arange(num)
    calls, same = BatchExecutor(1).map_blocks(sizes, numbers)
    np.testing.assert_array_equal(calls, np.full(num, size))
    np.testing.assert_array_equal(same, numbers)
    np.testing.assert_array_equal(BatchExecutor(None).map_blocks(sizes, numbers)[0], np.full(num, num))
