"""Tasks whose batches are computed together: one call, each with its own numbers, errors where they belong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_devices import settled, some

from driftjax.parallel import BatchExecutor, run_together

sizes_traced: list[int] = []


class Counted(BatchExecutor):
    """Records the size of each call."""

    def __init__(self):
        super().__init__(None)
        self.calls: list[int] = []

    def map(self, function, batch, *shared):
        self.calls.append(len(jax.tree.leaves(batch)[0]))
        return super().map(function, batch, *shared)


def ranked(x, rate):
    """A function that does one thing in large batches and another in small ones, as the drift MPC does."""
    sizes_traced.append(len(x))
    return {"x": rate * x, "batched": jnp.full(len(x), len(x) >= 4)}


def divided(batch):
    return batch[0] * (1 / 0)


@pytest.mark.usefixtures("empty_cache")
def test_calls_with_equal_shared_arrays_are_one_call_of_the_function():
    """The function gets the whole batch, so that what it does only for many entries is done."""
    counted, x = Counted(), jnp.arange(6.0)
    sizes_traced.clear()
    task = lambda i: lambda executor: executor.map(ranked, x[2 * i : 2 * i + 2], jnp.asarray(3.0))
    results = run_together(counted, [task(i) for i in range(3)])
    assert counted.calls == sizes_traced == [6]
    for i, result in enumerate(results):
        np.testing.assert_array_equal(result["x"], 3.0 * x[2 * i : 2 * i + 2])
        assert np.asarray(result["batched"]).all()


def test_calls_with_other_shared_arrays_are_one_batch_each_with_its_own_numbers():
    def task(rate, num, again):
        def run(executor):
            first = executor.map(settled, some(num), jnp.asarray(rate), "run")
            return [first] + ([executor.map(settled, some(num), jnp.asarray(2 * rate), "run")] if again else [])

        return run

    rates, counted = (0.1, 0.2, 0.3), Counted()
    results = run_together(counted, [task(rate, n, n > 2) for rate, n in zip(rates, (2, 3, 4), strict=True)])
    assert counted.calls == [9, 7]
    for one, rate, n in zip(results, rates, (2, 3, 4), strict=True):
        alone = BatchExecutor(None).map(settled, some(n), jnp.asarray(rate), "run")
        np.testing.assert_array_equal(one[0]["steps"], alone["steps"])
        np.testing.assert_allclose(one[0]["left"], alone["left"], rtol=1e-12)
        assert one[0]["label"] == "run"


@pytest.mark.parametrize("other", [jnp.arange(2), jnp.arange(4.0).reshape(2, 2)])
def test_calls_of_other_types_or_shapes_are_computed_apart(other):
    counted = Counted()
    batches = (jnp.arange(2.0), other)
    results = run_together(counted, [lambda executor, x=x: executor.map(ranked, x, 2) for x in batches])
    assert counted.calls == [2, 2]
    for x, result in zip(batches, results, strict=True):
        assert result["x"].dtype == x.dtype and result["x"].shape == x.shape


def test_an_error_of_a_task_or_of_a_batch_is_raised_and_holds_nobody_up():
    def fails(executor):
        raise ValueError("no such entry")

    def asks(executor):
        return executor.map(settled, some(2), jnp.asarray(0.1), "run")["steps"].shape

    with pytest.raises(ValueError, match="no such entry"):
        run_together(BatchExecutor(None), [asks, fails, asks])
    with pytest.raises(ZeroDivisionError):
        run_together(BatchExecutor(None), [lambda executor: executor.map(divided, some(2)), asks])
