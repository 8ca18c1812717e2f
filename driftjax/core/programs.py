"""Compiled programs that outlive the process before tracing: what JAX's own compilation cache leaves to do again.

JAX keeps compiled programs on disk but finds them only after it has traced and lowered the function, which takes
longer than loading them. Here the lowered program is kept beside them (`jax.export`), under a key of everything it
depends on: function, shapes, static values, sources and versions.
"""

import functools
import hashlib
import importlib.metadata
import pickle
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
from jax.stages import Compiled, Lowered
from jaxtyping import PyTree

from driftjax.core.atomic import write_atomically

PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "jaxopt", "numpy")

# LAPACK's routines that JAX does not promise to keep from version to version; the key holds the version.
UNCHECKED = [jax.export.DisabledSafetyCheck.custom_call(f"lapack_{name}_ffi") for name in ("dormqr", "sormqr")]


def call(function: Callable[..., PyTree], *args: Any) -> PyTree:
    """`function(*args)` jitted; `function` must be a module's own, without state. Arrays are traced, the rest static.
    It runs on the device on which they are.

    Without a compilation cache directory, and on a GPU, it is simply traced and compiled.
    """
    run, arrays, skeleton = _program(function, args)
    return _filled(skeleton, run(*arrays))


def prepare(function: Callable[..., PyTree], *args: Any) -> PyTree:
    """All of `call` but the computation: compiles, and returns zeros in the shapes of the result."""
    run, _, skeleton = _program(function, args)
    return _filled(skeleton, [jnp.zeros(out.shape, out.dtype) for out in run.out_info])


def _filled(skeleton: PyTree, found: list) -> PyTree:
    return jax.tree.map(lambda leaf: found[leaf.index] if isinstance(leaf, _Place) else leaf, skeleton)


def _program(function: Callable[..., PyTree], args: tuple) -> tuple[Compiled, list, PyTree]:
    """Compiled function of arrays only, those arrays, and the output with places for what it returns."""
    if "<" in function.__qualname__:
        raise ValueError(f"{function.__qualname__}: only functions of a module itself can be kept")
    leaves, structure = jax.tree.flatten(args)
    traced = tuple(map(eqx.is_array, leaves))
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    static = [None if eqx.is_array(leaf) else leaf for leaf in leaves]
    around = (jax.default_backend(), jax.config.values["jax_enable_x64"])
    devices = {device for leaf in arrays if isinstance(leaf, jax.Array) and leaf.committed for device in leaf.devices()}
    shapes = tuple(map(jax.typeof, arrays))
    key = (function, structure, traced, shapes, tuple(map(repr, static)), around, frozenset(devices))
    if key not in _programs:
        with _locks_guard:
            lock = _locks.setdefault(key, threading.Lock())
        with lock:  # of several threads one compiles
            if key not in _programs:
                _programs[key] = _compiled(_Plain(function, structure, static, traced), arrays, around)
    run, skeleton, _ = _programs[key]
    return run, arrays, skeleton


def _compiled(plain: "_Plain", arrays: list, around: tuple) -> tuple[Compiled, PyTree, "_Plain"]:
    """The program, from the folder if it is there."""
    shapes, (module, name) = [str(jax.typeof(a)) for a in arrays], (plain.function.__module__, plain.name)
    text = repr((module, name, plain.structure, plain.traced, shapes, plain.static, around, fingerprint()))
    # a value that prints as an address is another in each process; a GPU needs calls that cannot be kept
    folder = None if " at 0x" in text or jax.default_backend() != "cpu" else _folder()
    if folder is None:
        lowered, skeleton = _lowered(plain, arrays)
    else:
        lowered, skeleton = _kept(folder / f"{name}-{hashlib.sha256(text.encode()).hexdigest()}", plain, arrays)
    return lowered.compile(), skeleton, plain


def _folder() -> Path | None:
    """Where programs are kept, beside JAX's own compilation cache."""
    cache = jax.config.values["jax_compilation_cache_dir"]
    return None if cache is None else Path(cache) / "programs"


class _Place:
    """Where an array stands in the output."""

    def __init__(self, index: int):
        self.index = index


class _Plain:
    """A function of arrays only, which notes the structure of its output while it is traced."""

    def __init__(self, function: Callable[..., PyTree], structure: Any, static: list, traced: tuple[bool, ...]):
        self.function, self.structure, self.static, self.traced = function, structure, static, traced
        self.skeleton: PyTree = None

    @property
    def name(self) -> str:
        """Of the function in its module."""
        return self.function.__qualname__

    def __call__(self, *arrays):
        given = iter(arrays)
        leaves = [next(given) if is_array else leaf for leaf, is_array in zip(self.static, self.traced, strict=True)]
        out, structure = jax.tree.flatten(self.function(*jax.tree.unflatten(self.structure, leaves)))
        found = [leaf for leaf in out if eqx.is_array(leaf)]
        places = iter(range(len(found)))
        self.skeleton = jax.tree.unflatten(
            structure, [_Place(next(places)) if eqx.is_array(leaf) else leaf for leaf in out]
        )
        return found


# The function and its static values are held as well: while they live no other can take an address that a key holds.
_programs: dict[tuple, tuple[Compiled, PyTree, _Plain]] = {}
_locks: dict[tuple, threading.Lock] = {}
_locks_guard = threading.Lock()


def _lowered(plain: _Plain, arrays: list) -> tuple[Lowered, PyTree]:
    lowered = jax.jit(plain).lower(*arrays)
    return lowered, plain.skeleton


def _kept(path: Path, plain: _Plain, arrays: list) -> tuple[Lowered, PyTree]:
    """The program kept at `path`; it is traced and put there first where it is not."""
    if not path.is_file():
        exported = jax.export.export(jax.jit(plain), disabled_checks=UNCHECKED)(*arrays)
        path.parent.mkdir(parents=True, exist_ok=True)
        content = pickle.dumps((bytes(exported.serialize()), plain.skeleton))
        write_atomically(path, lambda p: p.write_bytes(content))
    serialized, skeleton = pickle.loads(path.read_bytes())
    return jax.jit(jax.export.deserialize(bytearray(serialized)).call).lower(*arrays), skeleton


def let_go(most: int = 30_000) -> None:
    """Give up all programs of this process where it holds more than `most` memory maps; each takes some hundreds.

    Linux allows a process 65530; beyond that XLA crashes. For workers that meet ever new programs, between tasks.
    """
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > most:
        _programs.clear()
        jax.clear_caches()


@functools.cache
def fingerprint() -> bytes:
    """Of this package and of the libraries that trace and lower it: what a program, and a result, depends on."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    digest.update(repr([importlib.metadata.version(name) for name in PACKAGES]).encode())
    return digest.digest()
