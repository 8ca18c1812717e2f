"""Lanes over all devices of this process, each computing its own: nothing passes between devices."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import PyTree

from driftjax.core.blocks import Blocks
from driftjax.core.programs import Plain, filled

AXIS = "lanes"


class Sharded(Blocks):
    """Blocks of `size` lanes on each device at once; all lanes in one call where it is None, as a GPU wants.

    A CPU wants one lane per device and call, as `Blocks` says. Batches are padded with their last lane to powers of
    two, so that few shapes are compiled, and cut in halves where the memory of the devices does not hold them.
    """

    def __init__(self, size: int | None, devices: Sequence[Any] | None = None):
        super().__init__(size)
        self.mesh = Mesh(np.array(devices or jax.local_devices()), (AXIS,))
        self._programs: dict[tuple, tuple[jax.stages.Wrapped, Plain, tuple[NamedSharding, ...]]] = {}
        self._most: int | None = None  # lanes of a call that the memory holds, once it was seen to be too small

    def map(self, function: Callable[..., PyTree], lanes: PyTree, *shared: Any) -> PyTree:
        """`function(lanes, *shared)`, whose arrays all have a leading axis of lanes, in and out."""
        num = next(len(leaf) for leaf in jax.tree.leaves(lanes) if eqx.is_array(leaf))
        width, found, done = self.mesh.size, [], 0
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
        return jax.tree.map(lambda *parts: jnp.concatenate(parts) if eqx.is_array(parts[0]) else parts[0], *found)

    def _call(self, function: Callable[..., PyTree], num: int, lanes: PyTree, shared: tuple) -> PyTree:
        leaves, structure = jax.tree.flatten((lanes, shared))
        first = len(jax.tree.leaves(lanes))
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        static = [None if eqx.is_array(leaf) else leaf for leaf in leaves]
        key = (function, structure, tuple(map(jax.typeof, arrays)), tuple(map(repr, static)))
        if key not in self._programs:
            specs = tuple(Spec(AXIS) if i < first else Spec() for i, leaf in enumerate(leaves) if eqx.is_array(leaf))
            plain = Plain(_spread(function), structure, static, tuple(map(eqx.is_array, leaves)))
            mapped = jax.shard_map(plain, mesh=self.mesh, in_specs=specs, out_specs=Spec(AXIS), check_vma=False)
            places = tuple(NamedSharding(self.mesh, spec) for spec in specs)
            self._programs[key] = jax.jit(mapped), plain, places
        run, plain, places = self._programs[key]
        out = run(*jax.device_put(arrays, list(places)))
        home = self.mesh.devices.flat[0]  # where what follows outside of any batch is computed
        return filled(plain.skeleton, [leaf[:num] for leaf in jax.device_put(out, home)])

    def text(self, function: Callable[..., PyTree], lanes: PyTree, *shared: Any) -> str:
        """The program that `map` runs, as the compiler leaves it: to see that nothing passes between devices."""
        self.map(function, lanes, *shared)
        run, _, places = next(reversed(self._programs.values()))
        num = next(len(leaf) for leaf in jax.tree.leaves(lanes) if eqx.is_array(leaf))
        whole = _cut(lanes, 0, num, self.mesh.size)
        arrays = [leaf for leaf in jax.tree.leaves((whole, shared)) if eqx.is_array(leaf)]
        return run.lower(*jax.device_put(arrays, list(places))).compile().as_text()


def _spread(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    return lambda lanes, shared: function(lanes, *shared)


def _cut(lanes: PyTree, begin: int, num: int, width: int) -> PyTree:
    """`num` lanes from `begin`, padded with the last of them to `width` times a power of two."""
    whole = width
    while whole < num:
        whole *= 2
    pick = np.minimum(np.arange(whole), num - 1) + begin
    return jax.tree.map(lambda a: jnp.asarray(a)[pick] if eqx.is_array(a) else a, lanes)
