"""Run tasks in threads and compute their equal calls as one batch."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from driftjax.parallel.batch import batch_size, concatenate, vmap_batch
from driftjax.parallel.executors import BatchExecutor

T = TypeVar("T")


def run_together(executor: BatchExecutor, tasks: Sequence[Callable[[BatchExecutor], T]]) -> list[T]:
    """Run each task in a thread of its own and return the results; raises the first error once all have ended.

    A task gets an executor whose `map` waits until all tasks that still run wait in it. Then calls of the same program
    (function, shapes and static values) are computed as one call of `executor`, on their concatenated batches.
    """
    meeting, futures = _Rendezvous(executor, len(tasks)), [Future() for _ in tasks]

    def run(task: Callable[[BatchExecutor], T], future: Future) -> None:
        try:
            future.set_result(task(meeting))
        except BaseException as error:  # raised by `run_together`
            future.set_exception(error)
        finally:
            meeting.arrive(None)

    for pair in zip(tasks, futures, strict=True):
        threading.Thread(target=run, args=pair, daemon=True).start()  # a pool would hold up Ctrl-C
    wait(futures)
    return [future.result() for future in futures]


class _Call(NamedTuple):
    """A call that a task waits for."""

    function: Callable[..., PyTree]
    batch: PyTree
    shared: tuple
    result: Future

    @property
    def program(self) -> tuple:
        """Return the key that is equal for calls that can be concatenated."""
        (batch, shared), static = eqx.partition((self.batch, self.shared), eqx.is_array)
        entry = [(a.dtype, a.shape[1:]) for a in jax.tree.leaves(batch)]
        shapes = [(a.dtype, a.shape) for a in jax.tree.leaves(shared)]
        leaves, structure = jax.tree.flatten(static)
        return self.function, structure, repr((entry, shapes, leaves))


class _Rendezvous(BatchExecutor):
    """Executor of the tasks; the thread that arrives last computes for all."""

    def __init__(self, executor: BatchExecutor, tasks: int):
        super().__init__(None)
        self._executor, self._tasks = executor, tasks
        self._waiting: list[_Call] = []
        self._lock = threading.Lock()

    def map(self, function: Callable[..., PyTree], batch: PyTree, *shared: Any) -> PyTree:
        """Return `function(batch, *shared)` once all other tasks wait or have ended."""
        self.arrive(call := _Call(function, batch, shared, Future()))
        return call.result.result()

    def arrive(self, call: _Call | None) -> None:
        """Add the call of one task, None if it has ended; once every running task waits, compute all calls."""
        with self._lock:
            self._tasks -= call is None
            self._waiting += [call] if call else []
            if len(self._waiting) < self._tasks:
                return
            calls, self._waiting = self._waiting, []
        groups: dict[tuple, list[_Call]] = {}
        for call in calls:
            groups.setdefault(call.program, []).append(call)
        # no result is set before all are computed: a task that has its own would go on beside the computation
        results = [(group, _attempt(self._executor, group)) for group in groups.values()]
        for group, (parts, error) in results:
            for i, call in enumerate(group):
                call.result.set_exception(error) if error else call.result.set_result(parts[i])


def _attempt(executor: BatchExecutor, calls: list[_Call]) -> tuple[list[PyTree], Exception | None]:
    try:
        return _compute(executor, calls), None
    except Exception as error:  # raised in every task that waits for it
        return [], error


def _compute(executor: BatchExecutor, calls: list[_Call]) -> list[PyTree]:
    """Compute calls of one program as one call, and return the part of each.

    Where shared arrays differ between calls, every entry gets a copy of its own and is mapped alone.
    """
    function, _, shared, _ = calls[0]
    sizes = [batch_size(call.batch) for call in calls]
    arrays = [eqx.filter(call.shared, eqx.is_array) for call in calls]
    if eqx.tree_equal(*arrays):
        result = executor.map(function, concatenate(*(call.batch for call in calls)), *shared)
    else:
        copies = [jax.tree.map(lambda a, n=n: jnp.broadcast_to(a, (n, *jnp.shape(a))), tree)
                  for tree, n in zip(arrays, sizes, strict=True)]  # fmt: skip
        entries = concatenate(*((call.batch, tree) for call, tree in zip(calls, copies, strict=True)))
        result = executor.map(_entry_alone, entries, function, eqx.filter(shared, eqx.is_array, inverse=True))
    parts, start = [], 0
    for size in sizes:
        part = slice(start, start := start + size)
        parts.append(jax.tree.map(lambda a, part=part: a[part] if eqx.is_array(a) else a, result))
    return parts


def _entry_alone(batch: tuple[PyTree, PyTree], function: Callable[..., PyTree], static: PyTree) -> PyTree:
    """Map `function` over entries (entry, its shared arrays), each as a batch of one."""

    def one(entry: PyTree, arrays: PyTree) -> PyTree:
        alone = jax.tree.map(lambda a: a[None] if eqx.is_array(a) else a, entry)
        result = function(alone, *eqx.combine(arrays, static))
        return jax.tree.map(lambda a: a[0] if eqx.is_array(a) else a, result)

    return vmap_batch(one)(*batch)
