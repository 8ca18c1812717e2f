"""Several tasks whose batches of lanes are computed as one: wherever all of them wait for lanes, they are joined."""

import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from driftjax.core.blocks import Blocks, end_to_end
from driftjax.core.each import each, num_lanes
from jaxtyping import PyTree

T = TypeVar("T")


class _Request:
    """What one task waits for."""

    def __init__(self, function: Callable[..., PyTree], lanes: PyTree, shared: tuple):
        self.function, self.lanes, self.shared = function, lanes, shared
        self.num = num_lanes(lanes)
        self.found: PyTree = None
        self.error: BaseException | None = None

    @property
    def kind(self) -> tuple:
        """Equal where requests can be one batch: the same program."""
        arrays, static = eqx.partition((self.lanes, self.shared), eqx.is_array)
        shapes = (
            [jnp.shape(leaf)[1:] for leaf in jax.tree.leaves(arrays[0])],
            list(map(jnp.shape, jax.tree.leaves(arrays[1]))),
        )
        leaves, structure = jax.tree.flatten(static)
        return self.function, structure, repr(shapes), repr(leaves)


class Joined:
    """`tasks` that each get `Blocks` of their own, side by side in threads; what they map runs joined on `blocks`.

    What differs between tasks, numbers among it, stands in the lanes then: they share one program.
    """

    def __init__(self, blocks: Blocks):
        self.blocks = blocks
        self._waiting: list[_Request] = []
        self._busy = 0
        self._changed = threading.Condition()

    def run(self, tasks: Sequence[Callable[[Blocks], T]]) -> list[T]:
        """What the tasks return; the first error of any of them is raised once all have ended."""
        found: list[Any] = [None] * len(tasks)
        errors: list[BaseException] = []
        self._busy = len(tasks)

        def one(i: int) -> None:
            try:
                found[i] = tasks[i](_Seat(self))
            except BaseException as error:  # of a thread: raised by `run`
                errors.append(error)
            finally:
                with self._changed:
                    self._busy -= 1
                    self._serve()

        threads = [threading.Thread(target=one, args=(i,), daemon=True) for i in range(len(tasks))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if errors:
            raise errors[0]
        return found

    def ask(self, request: _Request) -> PyTree:
        """What `request` is for, once all tasks that go on have asked."""
        with self._changed:
            self._waiting.append(request)
            self._busy -= 1
            self._serve()
            while request.found is None and request.error is None:
                self._changed.wait()
        if request.error is not None:
            raise request.error
        return request.found

    def _serve(self) -> None:
        """Compute what all wait for; whoever comes last does it."""
        if self._busy or not self._waiting:
            return
        kinds: dict[tuple, list[_Request]] = {}
        for request in self._waiting:
            kinds.setdefault(request.kind, []).append(request)
        for requests in kinds.values():
            try:
                _compute(self.blocks, requests)
            except Exception as error:  # told to every task that asked
                for request in requests:
                    request.error = error
        self._busy += len(self._waiting)
        self._waiting = []
        self._changed.notify_all()


class _Seat(Blocks):
    def __init__(self, joined: Joined):
        super().__init__(None)
        self._joined = joined

    def map(self, function: Callable[..., PyTree], lanes: PyTree, *shared: Any) -> PyTree:
        return self._joined.ask(_Request(function, lanes, shared))


def _compute(blocks: Blocks, requests: list[_Request]) -> None:
    """All requests, which share a program, as one batch of lanes, each with what its task shares among its own."""
    wholes = []
    for request in requests:
        arrays = eqx.filter(request.shared, eqx.is_array)
        spread = jax.tree.map(lambda a, num=request.num: jnp.broadcast_to(a, (num, *jnp.shape(a))), arrays)
        wholes.append((request.lanes, spread))
    lanes = jax.tree.map(end_to_end, *wholes)
    static = eqx.filter(requests[0].shared, eqx.is_array, inverse=True)
    found, begin = blocks.map(in_lanes, lanes, requests[0].function, static), 0
    for request in requests:
        part = slice(begin, begin + request.num)
        request.found = jax.tree.map(lambda a, part=part: a[part] if eqx.is_array(a) else a, found)
        begin += request.num


def in_lanes(lanes: tuple[PyTree, PyTree], function: Callable[..., PyTree], static: PyTree) -> PyTree:
    """`function` of lanes given as (its lanes, the arrays that it shares, once per lane)."""

    def one(lane: PyTree, arrays: PyTree) -> PyTree:
        alone = jax.tree.map(lambda a: a[None] if eqx.is_array(a) else a, lane)
        found = function(alone, *eqx.combine(arrays, static))
        return jax.tree.map(lambda a: a[0] if eqx.is_array(a) else a, found)

    return each(one)(*lanes)
