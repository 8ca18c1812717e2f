"""Lanes computed in blocks beside each other: in worker processes or threads on a CPU, in one call on a GPU."""

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
from driftjax.core.each import num_lanes
from driftjax.core.programs import call, prepare
from jaxtyping import PyTree

T = TypeVar("T")
SETTINGS = (
    "jax_enable_x64",
    "jax_cpu_enable_async_dispatch",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
)


class Blocks:
    """How a function of a batch of lanes is computed: blocks of `size` lanes, one after the other or in workers.

    A CPU gains nothing from more than one lane per call: it takes as long per lane, and all lanes of a call iterate
    until the slowest has converged. Blocks of one also give the same bits in every batch and on any number of
    workers, and compile one shape only. Long elementwise programs of thousands of lanes are the exception: see
    `threads`. A GPU wants all lanes in one call: `size` None.
    """

    def __init__(self, size: int | None = 1, pool: Executor | None = None):
        self.size, self.pool = size, pool

    def map(self, function: Callable[..., PyTree], lanes: PyTree, *shared: Any) -> PyTree:
        """`function(lanes, *shared)`, whose arrays all have a leading axis of lanes, in and out.

        `function` must be a module's own, so that it can be imported and kept (see `call`).
        """
        num = num_lanes(lanes)
        size = num if self.size is None else self.size
        if size >= num and self.pool is None:
            return call(function, lanes, *shared)
        arrays = jax.tree.map(_plain, lanes)
        cut = [jax.tree.map(lambda a, i=i: a[i : i + size] if eqx.is_array(a) else a, arrays)
               for i in range(0, num, size)]  # fmt: skip
        if self.pool is None:
            found = [_call(function, block, *shared) for block in cut]
        else:
            others = jax.tree.map(_plain, shared)
            each = self.pool.map(_call, *zip(*((function, block, *others) for block in cut), strict=True))
            found = _arrived(lambda: list(each))
        return jax.tree.map(end_to_end, *found)

    def begin(self, function: Callable[..., T], *args: Any) -> Callable[[], T]:
        """`function(*args)` begun in a worker; without one, put off until the result is asked for."""
        if self.pool is None:
            return lambda: function(*args)
        future = self.pool.submit(function, *args)
        return lambda: _arrived(future.result)


class Rehearsal(Blocks):
    """Lanes that are not computed: one worker compiles what `map` would call, and zeros come back."""

    def __init__(self, pool: Executor):
        super().__init__()
        self._workers = pool
        self._begun: dict[str, Future] = {}
        self._lock = threading.Lock()

    def map(self, function: Callable[..., PyTree], lanes: PyTree, *shared: Any) -> PyTree:
        """Zeros in the shapes of `Blocks.map`."""
        num, args = num_lanes(lanes), (jax.tree.map(_first, lanes), *jax.tree.map(_plain, shared))
        name = repr((function.__qualname__, jax.tree.structure(args)))
        with self._lock:
            if name not in self._begun:
                self._begun[name] = self._workers.submit(_prepare, function, *args)
        return jax.tree.map(lambda a: jnp.zeros((num, *a.shape[1:]), a.dtype) if eqx.is_array(a) else a,
                            self._begun[name].result())  # fmt: skip


def _arrived(result: Callable[[], T]) -> T:
    try:
        return result()
    except BrokenProcessPool:
        raise RuntimeError(
            "a worker process died, perhaps for want of memory; free some or give fewer --workers"
        ) from None


def end_to_end(*parts: Any) -> Any:
    """Arrays end to end; what is no array is the same in all."""
    if not eqx.is_array(parts[0]):
        return parts[0]
    return jnp.asarray(np.concatenate(parts)) if isinstance(parts[0], np.ndarray) else jnp.concatenate(parts)


def _first(leaf: Any) -> Any:
    return _plain(leaf)[:1] if eqx.is_array(leaf) else leaf


def _plain(leaf: Any) -> Any:
    """Arrays in NumPy's own type, so that cutting them compiles nothing; random keys have none."""
    whole = eqx.is_array(leaf) and not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(leaf) if whole else leaf


def _call(function: Callable[..., PyTree], *args: Any) -> PyTree:
    return jax.tree.map(_plain, call(function, *args))


def _prepare(function: Callable[..., PyTree], *args: Any) -> PyTree:
    return jax.tree.map(_plain, prepare(function, *args))


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def num_workers(lanes: int) -> int:
    """Worker processes that pay for `lanes` lanes: none on a GPU or a single core."""
    useful = min(num_cores(), lanes)
    return useful if jax.default_backend() == "cpu" and useful > 1 else 0


@contextmanager
def workers(num: int) -> Iterator[Blocks]:
    """Blocks computed by `num` processes, which end with the context however it is left; 0 stays in this process."""
    if num == 0:
        yield Blocks(1 if jax.default_backend() == "cpu" else None)
        return
    with process_pool(num) as pool:
        yield Blocks(1, pool)


@contextmanager
def process_pool(num: int) -> Iterator[ProcessPoolExecutor]:
    """`num` processes with this one's settings, which end with the context however it is left."""
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(num, multiprocessing.get_context("spawn"), _begin, (settings(),))
    for _ in range(num):
        pool.submit(os.getpid)  # the pool starts its processes on demand: let them load now
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()


def threads(lanes: int, num: int) -> Blocks:
    """Blocks of `lanes` lanes in as many equal parts as there are threads of this process.

    For programs without LAPACK calls, elementwise over so many lanes that one call keeps a core busy for longer than
    it takes to begin. A thread computes its own part only where JAX does not dispatch in the background
    (`jax_cpu_enable_async_dispatch` false, as the command line has it). On a GPU all lanes are one block.
    """
    alone = num == 1 or jax.default_backend() != "cpu"
    return Blocks(None) if alone else Blocks(-(-lanes // num), ThreadPoolExecutor(num))


def settings() -> dict[str, Any]:
    """What a worker must have as this process has it."""
    return {name: jax.config.values[name] for name in SETTINGS}


def set_up(known: dict[str, Any]) -> None:
    """Another process's `settings` in this one."""
    for name, value in known.items():
        jax.config.update(name, value)


def _begin(known: dict[str, Any]) -> None:
    """First thing in a worker: the parent's settings; Ctrl-C is the parent's to handle; end when it is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_up(known)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            wait([parent.sentinel])
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
