"""Lanes over all devices of this process, each computing its own: nothing passes between devices."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from driftjax.core.blocks import Blocks, end_to_end
from driftjax.core.each import num_lanes
from driftjax.core.programs import call
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import PyTree

AXIS = "lanes"


class Sharded(Blocks):
    """Blocks of `size` lanes on each device at once; all lanes in one call where it is None, as a GPU wants.

    A CPU wants one lane per device and call, as `Blocks` says. Batches are padded with their last lane to powers of
    two, so that few shapes are compiled, and cut in halves where the memory of the devices does not hold them. Every
    device runs the program of one: the same program partitioned by the compiler rounds otherwise, and a car that
    slides makes another lap of that.
    """

    def __init__(self, size: int | None, devices: Sequence[Any] | None = None):
        super().__init__(size)
        self.mesh = Mesh(np.array(devices or jax.local_devices()), (AXIS,))
        self._threads = ThreadPoolExecutor(self.mesh.size)
        self._most: int | None = None  # lanes of a call that the memory holds, once it was seen to be too small

    def map(self, function: Callable[..., PyTree], lanes: PyTree, *shared: Any) -> PyTree:
        """`function(lanes, *shared)`, whose arrays all have a leading axis of lanes, in and out."""
        num = num_lanes(lanes)
        shared, width = self._placed(shared, Spec()), self.mesh.size
        found, done = [], 0
        while done < num:
            wanted = num - done if self.size is None else min(num - done, self.size * width)
            wanted = wanted if self._most is None else min(wanted, self._most)
            try:
                found.append(self._call(function, wanted, _cut(lanes, done, wanted, width), shared))
                done += wanted
            except jax.errors.JaxRuntimeError as error:
                if "RESOURCE_EXHAUSTED" not in str(error) or wanted <= width:
                    raise
                self._most = wanted // 2
        return jax.tree.map(end_to_end, *found)

    def _call(self, function: Callable[..., PyTree], num: int, lanes: PyTree, shared: tuple) -> PyTree:
        lanes = self._placed(lanes, Spec(AXIS))
        each = num_lanes(lanes) // self.mesh.size
        places = list(self.mesh.devices.flat)[: -(-num // each)]  # those with more than padding
        parts = self._threads.map(lambda at: call(function, _on(lanes, at), *_on(shared, at)), places)
        home = places[0]  # where what follows outside of any batch is computed

        def whole(*leaves: Any) -> Any:
            return jnp.concatenate(jax.device_put(leaves, home))[:num] if eqx.is_array(leaves[0]) else leaves[0]

        return jax.tree.map(whole, *parts)

    def _placed(self, tree: PyTree, spec: Spec) -> PyTree:
        sharding = NamedSharding(self.mesh, spec)
        return jax.tree.map(lambda a: jax.device_put(a, sharding) if eqx.is_array(a) else a, tree)


def _on(tree: PyTree, device: Any) -> PyTree:
    """The part of arrays that lies on a device."""

    def part(leaf: Any) -> Any:
        return next(s.data for s in leaf.addressable_shards if s.device == device) if eqx.is_array(leaf) else leaf

    return jax.tree.map(part, tree)


def _cut(lanes: PyTree, begin: int, num: int, width: int) -> PyTree:
    """`num` lanes from `begin`, padded with the last of them to `width` times a power of two."""
    whole = width
    while whole < num:
        whole *= 2
    pick = np.minimum(np.arange(whole), num - 1) + begin
    return jax.tree.map(lambda a: jnp.asarray(a)[pick] if eqx.is_array(a) else a, lanes)
