"""Batches over all devices of this process; nothing passes between devices."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import PyTree

from driftjax.parallel.batch import batch_size, concatenate
from driftjax.parallel.executors import BatchExecutor
from driftjax.parallel.programs import call

AXIS = "batch"


class DeviceExecutor(BatchExecutor):
    """Compute calls of `chunk` entries on every device at once; one call per device where it is None.

    A CPU needs `chunk` 1, see `BatchExecutor`; a GPU None. Batches are padded with copies of their last entry to powers
    of two per device, so that few shapes are compiled, and halved when the memory of the devices is too small. Every
    device runs the single-device program: a program that the compiler partitions rounds differently, and a sliding car
    then drives another lap.
    """

    def __init__(self, chunk: int | None, devices: Sequence[Any] | None = None):
        super().__init__(chunk)
        self.mesh = Mesh(np.array(devices or jax.local_devices()), (AXIS,))
        self._most: int | None = None  # entries of one call that fit into the memory, known after one that did not

    def map_blocks(self, function: Callable[..., PyTree], batch: PyTree, *shared: Any) -> PyTree:
        """Return what `map` returns: the calls are those of the devices."""
        return self.map(function, batch, *shared)

    def map(self, function: Callable[..., PyTree], batch: PyTree, *shared: Any) -> PyTree:
        """Return `function(batch, *shared)`; all arrays of `batch` and of the result have a leading batch axis."""
        num, width = batch_size(batch), self.mesh.size
        shared, results, done = self._place(shared, Spec()), [], 0
        while done < num:
            size = num - done if self.chunk is None else min(num - done, self.chunk * width)
            size = size if self._most is None else min(size, self._most)
            try:
                results.append(self._call(function, size, _padded(batch, done, size, width), shared))
                done += size
            except jax.errors.JaxRuntimeError as error:
                if "RESOURCE_EXHAUSTED" not in str(error) or size <= width:
                    raise
                self._most = size // 2
        return concatenate(*results)

    def _call(self, function: Callable[..., PyTree], num: int, batch: PyTree, shared: tuple) -> PyTree:
        batch = self._place(batch, Spec(AXIS))
        per_device = batch_size(batch) // self.mesh.size
        devices = list(self.mesh.devices.flat)[: -(-num // per_device)]  # those with more than padding
        with ThreadPoolExecutor(len(devices)) as threads:
            parts = list(threads.map(lambda d: call(function, _shard(batch, d), *_shard(shared, d)), devices))

        def gather(*leaves: Any) -> Any:
            if not eqx.is_array(leaves[0]):
                return leaves[0]
            return jnp.concatenate(jax.device_put(leaves, devices[0]))[:num]

        return jax.tree.map(gather, *parts)

    def _place(self, tree: PyTree, spec: Spec) -> PyTree:
        sharding = NamedSharding(self.mesh, spec)
        return jax.tree.map(lambda a: jax.device_put(a, sharding) if eqx.is_array(a) else a, tree)


def _shard(tree: PyTree, device: Any) -> PyTree:
    """Return the parts of the arrays that lie on `device`."""

    def part(leaf: Any) -> Any:
        return next(s.data for s in leaf.addressable_shards if s.device == device) if eqx.is_array(leaf) else leaf

    return jax.tree.map(part, tree)


def _padded(batch: PyTree, start: int, num: int, width: int) -> PyTree:
    """Return `num` entries from `start`, padded with the last of them to `width` times a power of two."""
    size = width
    while size < num:
        size *= 2
    index = np.minimum(np.arange(size), num - 1) + start
    return jax.tree.map(lambda a: jnp.asarray(a)[index] if eqx.is_array(a) else a, batch)
