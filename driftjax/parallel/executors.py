"""Executors of batched functions: in this process, in threads or in worker processes."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from driftjax.environment import FUSED, FUSED_RESULTS, add_flag, fuses_results
from driftjax.parallel.batch import batch_size, concatenate
from driftjax.parallel.programs import call, compile_ahead

T = TypeVar("T")
BLOCK = 16  # most entries of a call
SETTINGS = (
    "jax_enable_x64",
    "jax_cpu_enable_async_dispatch",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
)


class BatchExecutor:
    """Compute a function of a batch in calls of `chunk` entries, one after the other or on the workers of `pool`.

    The whole batch is one call where `chunk` is None, which is what a GPU needs. On a CPU calls of one entry give the
    same bits for every batch and number of workers, and compile for one shape only; most functions take as long per
    entry in a larger call, which iterates until the slowest entry has converged. For those that gain see `map_blocks`,
    and for long elementwise programs of thousands of entries `thread_executor`.
    """

    def __init__(self, chunk: int | None = 1, pool: Executor | None = None):
        self.chunk, self.pool = chunk, pool

    def map(self, function: Callable[..., PyTree], batch: PyTree, *shared: Any) -> PyTree:
        """Return `function(batch, *shared)`; all arrays of `batch` and of the result have a leading batch axis.

        `function` must be defined at the top level of a module, so that workers can import it (see `call`).
        """
        return self._map(self.chunk, function, batch, *shared)

    def map_blocks(self, function: Callable[..., PyTree], batch: PyTree, *shared: Any) -> PyTree:
        """Return what `map` returns, computed in calls of `block_size` entries on a CPU.

        For functions whose entries are elementwise on one axis, and seldom wait for each other, such as laps: a call of
        many fills the processor's vector registers. The last call is filled up with copies of its last entry.
        """
        if self.chunk != 1:
            return self.map(function, batch, *shared)
        return self._map(block_size(batch_size(batch)), function, batch, *shared)

    def _map(self, chunk: int | None, function: Callable[..., PyTree], batch: PyTree, *shared: Any) -> PyTree:
        num = batch_size(batch)
        chunk = num if chunk is None else chunk
        if chunk >= num and self.pool is None:
            return call(function, batch, *shared)
        arrays, last = jax.tree.map(_to_numpy, batch), np.full(-num % chunk, num - 1)
        some = lambda i: np.append(np.arange(i, min(i + chunk, num)), last[: max(0, i + chunk - num)])
        chunks = [_entries(arrays, some(i)) for i in range(0, num, chunk)]
        if self.pool is None:
            return _entries(concatenate(*(_call(function, one, *shared) for one in chunks)), slice(num))
        shared = jax.tree.map(_to_numpy, shared)
        results = self.pool.map(_call, *zip(*((function, one, *shared) for one in chunks), strict=True))
        return _entries(concatenate(*_result(lambda: list(results))), slice(num))

    def submit(self, function: Callable[..., T], *args: Any) -> Callable[[], T]:
        """Start `function(*args)` in a worker and return a function that waits for its result.

        Without workers the call is made when the result is asked for.
        """
        if self.pool is None:
            return lambda: function(*args)
        future = self.pool.submit(function, *args)
        return lambda: _result(future.result)


class CompileAheadExecutor(BatchExecutor):
    """Compile the programs of `BatchExecutor.map` in the workers, each once, and return zeros."""

    def __init__(self, pool: Executor):
        super().__init__()
        self._workers = pool
        self._compiled: dict[str, Future] = {}
        self._lock = threading.Lock()

    def map(self, function: Callable[..., PyTree], batch: PyTree, *shared: Any) -> PyTree:
        """Return zeros of the shapes that `BatchExecutor.map` returns."""
        return self._map(self.chunk, function, batch, *shared)

    def _map(self, chunk: int | None, function: Callable[..., PyTree], batch: PyTree, *shared: Any) -> PyTree:
        num, one = batch_size(batch), _entries(jax.tree.map(_to_numpy, batch), slice(chunk))
        args = (one, *jax.tree.map(_to_numpy, shared))
        name = repr((function.__qualname__, jax.tree.structure(args)))
        with self._lock:
            if name not in self._compiled:
                self._compiled[name] = self._workers.submit(_compile_ahead, function, *args)
        return jax.tree.map(lambda a: jnp.zeros((num, *a.shape[1:]), a.dtype) if eqx.is_array(a) else a,
                            self._compiled[name].result())  # fmt: skip


def _result(wait_for: Callable[[], T]) -> T:
    try:
        return wait_for()
    except BrokenProcessPool:
        raise RuntimeError(
            "a worker process died, perhaps for want of memory; free some or give fewer --workers, "
            f"or set {FUSED}=0, if XLA failed in it"
        ) from None


def _entries(batch: PyTree, which: Any) -> PyTree:
    """Return some entries of the arrays of a batch."""
    return jax.tree.map(lambda a: a[which] if eqx.is_array(a) else a, batch)


def _to_numpy(leaf: Any) -> Any:
    """Return arrays as NumPy's, whose slices compile nothing; random keys have no such form."""
    plain = eqx.is_array(leaf) and not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(leaf) if plain else leaf


def _call(function: Callable[..., PyTree], *args: Any) -> PyTree:
    return jax.tree.map(_to_numpy, call(function, *args))


def _compile_ahead(function: Callable[..., PyTree], *args: Any) -> PyTree:
    return jax.tree.map(_to_numpy, compile_ahead(function, *args))


def num_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def block_size(entries: int) -> int:
    """Return the number of entries of one call, at most `BLOCK`: as few calls as keep all cores busy alike."""
    entries = max(entries, 1)
    calls = -(-entries // (BLOCK * num_cores())) * num_cores()
    return -(-entries // calls)


def num_workers(entries: int) -> int:
    """Return the number of workers to start for `entries`; 0 on a GPU or one core."""
    useful = min(num_cores(), entries)
    return useful if jax.default_backend() == "cpu" and useful > 1 else 0


def spare_workers() -> int:
    """Return the `workers` of `diagnose` on this machine: 1 where two cores are free and no GPU computes, else 0."""
    return min(num_workers(2), 1)


@contextmanager
def process_executor(num: int, fused: bool = False) -> Iterator[BatchExecutor]:
    """Compute batches in `num` worker processes, which end with the context; with 0, in this process.

    `fused` is for laps: on a CPU at least one worker process then computes them, twice as fast (`FUSED_RESULTS`),
    unless this process has that flag itself.
    """
    on_cpu = jax.default_backend() == "cpu"
    fused = fused and on_cpu and fuses_results() and FUSED_RESULTS not in os.environ.get("XLA_FLAGS", "").split()
    if num == 0 and not fused:
        yield BatchExecutor(1 if on_cpu else None)
        return
    with process_pool(max(num, 1), fused) as pool:
        yield BatchExecutor(1, pool)


@contextmanager
def process_pool(num: int, fused: bool = False) -> Iterator[ProcessPoolExecutor]:
    """Start `num` processes with the settings of this one; they are terminated when the context ends."""
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(num, multiprocessing.get_context("spawn"), _start_worker, (settings(), fused))
    for _ in range(num):
        pool.submit(os.getpid)  # the pool starts its processes on demand: let them load now
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()


@contextmanager
def thread_executor(entries: int, num: int) -> Iterator[BatchExecutor]:
    """Compute batches of `entries` in `num` equal parts, one per thread; the threads end with the context.

    For programs without LAPACK calls, elementwise over so many entries that one call keeps a core busy for longer than
    it takes to start. A thread computes its own part only where JAX does not dispatch in the background
    (`jax_cpu_enable_async_dispatch` false, as the package sets it). On a GPU the batch is one call.
    """
    if num == 1 or jax.default_backend() != "cpu":
        yield BatchExecutor(None)
        return
    with ThreadPoolExecutor(num) as pool:
        yield BatchExecutor(-(-entries // num), pool)


def settings() -> dict[str, Any]:
    """Return the JAX settings that a worker must share with this process."""
    return {name: jax.config.values[name] for name in SETTINGS}


def apply_settings(values: dict[str, Any]) -> None:
    """Apply the `settings` of another process."""
    for name, value in values.items():
        jax.config.update(name, value)


def _start_worker(values: dict[str, Any], fused: bool) -> None:
    """Apply the parent's settings, leave Ctrl-C to the parent, and end when the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if fused:
        add_flag(FUSED_RESULTS)  # before the first program starts XLA's client
    apply_settings(values)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            wait([parent.sentinel])
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
