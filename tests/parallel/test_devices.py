"""Batches over eight forced devices: the bits of one device, nothing passed between devices, cut to the memory."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.parallel import BatchExecutor, DeviceExecutor


def settled(batch, rate, label):
    """How many steps each entry takes to fall below one, and what is left of it."""
    x, keys = batch

    def one(x, key):
        step = lambda state: (state[0] * (1 - rate) + 1e-3 * jax.random.normal(key), state[1] + 1)
        return jax.lax.while_loop(lambda state: state[0] > 1.0, step, (x, 0))

    left, steps = jax.vmap(one)(x, keys)
    return {"left": left, "steps": steps, "label": label}


def some(num):
    return jnp.linspace(2.0, 50.0, num), jax.random.split(jax.random.key(0), num)


def test_one_device_gives_what_executor_give():
    result = DeviceExecutor(None).map(settled, some(5), jnp.asarray(0.1), "run")
    expected = BatchExecutor(None).map(settled, some(5), jnp.asarray(0.1), "run")
    np.testing.assert_array_equal(result["left"], expected["left"])
    np.testing.assert_array_equal(result["steps"], expected["steps"])
    assert result["label"] == "run"


CHILD = """
import json, jax
import driftjax
from driftjax.parallel import BatchExecutor, DeviceExecutor, programs
from tests.parallel.test_devices import settled, some
import jax.numpy as jnp
rate, out = jnp.asarray(0.1), {"devices": len(jax.devices())}
for size in (None, 1):
    result = DeviceExecutor(size).map(settled, some(19), rate, "run")
    out[str(size)] = [result["left"].tolist(), result["steps"].tolist()]
texts = {key[-1]: program[0].as_text() for key, program in programs._programs.items()}
one = BatchExecutor(1).map(settled, some(19), rate, "run")
out["one"] = [one["left"].tolist(), one["steps"].tolist()]
ran_on = lambda: str(*programs.call(settled, some(5), rate, "run")["left"].devices())
out["defaults"] = [ran_on()]
with jax.default_device(jax.devices()[3]):
    out["defaults"].append(ran_on())
out["where"], out["text"] = sorted(str(*devices) for devices in texts), " ".join(texts.values())
print(json.dumps(out))
"""


@pytest.mark.slow
def test_eight_devices_give_the_same_bits_and_pass_nothing(tmp_path):
    env = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=8", "JAX_PLATFORMS": "cpu"}
    env |= {"PYTHONPATH": str(Path(__file__).parents[2]), "JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", CHILD], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout)
    assert results["devices"] == 8 and len(results["where"]) == 8
    assert results["None"] == results["one"] and results["1"] == results["one"]
    assert results["defaults"] == ["cpu:0", "cpu:3"]
    for passing in ("all-gather", "all-reduce", "all-to-all", "collective-permute", "reduce-scatter"):
        assert passing not in results["text"]


def test_device_threads_end_with_each_call():
    before = threading.active_count()
    DeviceExecutor(None).map(settled, some(3), jnp.asarray(0.1), "run")
    assert threading.active_count() == before


def test_a_batch_is_cut_where_the_memory_is_too_small(monkeypatch):
    executor, calls = DeviceExecutor(None), []
    expected = executor.map(settled, some(8), jnp.asarray(0.1), "run")
    call = executor._call

    def short_of_memory(function, num, batch, shared):
        calls.append(num)
        if num > 3:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")
        return call(function, num, batch, shared)

    monkeypatch.setattr(executor, "_call", short_of_memory)
    result = executor.map(settled, some(8), jnp.asarray(0.1), "run")
    np.testing.assert_array_equal(result["left"], expected["left"])
    assert calls == [8, 4, 2, 2, 2, 2]
    calls.clear()
    executor.map(settled, some(4), jnp.asarray(0.1), "run")
    assert calls == [2, 2]  # it is remembered
