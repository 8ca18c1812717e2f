"""Store compiled programs on disk and load them without tracing.

JAX finds compiled programs on disk only after it has traced and lowered the function, which takes longer than loading
them. Here lowered programs are stored beside them (`jax.export`), under a hash of everything that they depend on:
function, shapes, static values, versions, and the source of the modules that the function and the types of its
arguments come from with all that these import. Programs used least recently are deleted beyond a size of 1 GB, or of
the number of bytes in the environment variable DRIFTJAX_PROGRAM_CACHE_BYTES.

Where programs are compiled more often than run, as in tests, XLA_FLAGS=--xla_backend_optimization_level=0 saves half of
that time; the functions that DRIFTJAX_OPTIMISED names, with commas between, are optimised all the same.
"""

import fcntl
import hashlib
import os
import pickle
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jax.stages import Compiled, Lowered
from jaxtyping import PyTree

from driftjax.core import BadInput, write_atomically
from driftjax.parallel.source import source_hash, unchanged

LIMIT = "DRIFTJAX_PROGRAM_CACHE_BYTES"
OPTIMISED = "DRIFTJAX_OPTIMISED"

# LAPACK's routines that JAX does not promise to keep from version to version; the key holds the version.
UNCHECKED = [jax.export.DisabledSafetyCheck.custom_call(f"lapack_{name}_ffi") for name in ("dormqr", "sormqr")]


def call(function: Callable[..., PyTree], *args: Any) -> PyTree:
    """Return `function(*args)` jitted, computed on the device that holds the arguments.

    Arrays are traced, all else is static. `function` must be defined at the top level of a module, without state.
    Without a compilation cache directory, and on a GPU, nothing is stored.
    """
    run, arrays, skeleton = _program(function, args)
    return _filled(skeleton, run(*arrays))


def compile_ahead(function: Callable[..., PyTree], *args: Any) -> PyTree:
    """Compile the program of `call`, and return zeros of the shapes of its result."""
    run, _, skeleton = _program(function, args)
    return _filled(skeleton, [jnp.zeros(out.shape, out.dtype) for out in run.out_info])


def _filled(skeleton: PyTree, arrays: list) -> PyTree:
    return jax.tree.map(lambda leaf: arrays[leaf.index] if isinstance(leaf, _Place) else leaf, skeleton)


def _program(function: Callable[..., PyTree], args: tuple) -> tuple[Compiled, list, PyTree]:
    """Return the compiled function of arrays only, those arrays, and its output with a `_Place` for each array."""
    if "<" in function.__qualname__:
        raise ValueError(f"{function.__qualname__}: only functions at the top level of a module can be stored")
    leaves, structure = jax.tree.flatten(args)
    leaves = list(map(_strongly_typed, leaves))
    traced = tuple(map(eqx.is_array, leaves))
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    static = [None if eqx.is_array(leaf) else leaf for leaf in leaves]
    settings = (jax.default_backend(), jax.config.values["jax_enable_x64"])
    devices = {device for leaf in arrays if isinstance(leaf, jax.Array) and leaf.committed for device in leaf.devices()}
    default = _default_device()
    devices -= {default}
    shapes = tuple(map(jax.typeof, arrays))
    key = (function, structure, traced, shapes, tuple(map(repr, static)), settings, default, frozenset(devices))
    if key not in _programs:
        with _locks_guard:
            lock = _locks.setdefault(key, threading.Lock())
        with lock:  # of several threads one compiles
            if key not in _programs:
                like = arrays if devices else list(map(_unplaced, shapes))
                _programs[key] = _compiled(_Plain(function, structure, static, traced), like, settings)
    run, skeleton, _ = _programs[key]
    return run, arrays, skeleton


def _unplaced(a: Any) -> jax.ShapeDtypeStruct:
    """Return shape and type alone."""
    return jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type)


def _default_device() -> Any:
    """Return the device of arrays that were put on none: arrays put on it explicitly share their programs."""
    return jax.config.values["jax_default_device"] or jax.local_devices()[0]


def _strongly_typed(leaf: Any) -> Any:
    """Return a weakly typed integer as one of fixed type, so that both share one program.

    Floats stay: a Python number does not make single precision double, a number of type float64 does.
    """
    weak = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jnp.integer) and leaf.weak_type
    return np.asarray(leaf) if weak and len(leaf.devices()) == 1 else leaf


def _compiled(plain: "_Plain", arrays: list, settings: tuple) -> tuple[Compiled, PyTree, "_Plain"]:
    """Compile the program, from its stored form where there is one."""
    options = _compiler_options(plain.function.__name__)
    if (path := _path(plain, arrays, settings)) is None:
        return jax.jit(plain).lower(*arrays).compile(options), plain.skeleton, plain
    with _file_lock(path):
        lowered, skeleton = _stored(path, plain, arrays)
        return lowered.compile(options), skeleton, plain


def _compiler_options(name: str) -> dict[str, str | bool] | None:
    """Return XLA's options for the function of this name, beside those in XLA_FLAGS."""
    return {"xla_backend_optimization_level": "3"} if name in os.environ.get(OPTIMISED, "").split(",") else None


@contextmanager
def _file_lock(path: Path) -> Iterator[None]:
    """Let one of several processes compile the program at `path`; the others wait and load it.

    A process that ends gives its locks back. A lock file deleted by its last holder while another process opens it
    costs a second compilation at worst. Where no file can be written, nothing is locked: see `_stored`.
    """
    lock = path.with_name(f".{path.name}.lock")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = lock.open("w")
    except OSError:
        yield
        return
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            with suppress(OSError):
                lock.unlink(missing_ok=True)


def _path(plain: "_Plain", arrays: list, settings: tuple) -> Path | None:
    """Return where the program is stored; None where it must not be."""
    cache, shapes = jax.config.values["jax_compilation_cache_dir"], [str(jax.typeof(a)) for a in arrays]
    name, module = plain.function.__qualname__, plain.function.__module__
    text = repr((module, name, plain.structure, plain.traced, shapes, plain.static, settings))
    # a value that prints as an address is another in each process; a GPU needs calls that cannot be exported
    if cache is None or " at 0x" in text or jax.default_backend() != "cpu":
        return None
    of_values = {
        getattr(value, "__module__", None) or "builtins" for value in (*_nodes(plain.structure), *plain.static)
    }
    others = sorted(name for name in of_values if name.split(".")[0] not in sys.stdlib_module_names)
    modules = (module, *others)
    try:
        source = source_hash(*modules)
    except LookupError:  # typed into an interpreter
        return None
    key = hashlib.sha256(text.encode() + source).hexdigest()
    return Path(cache) / "programs" / f"{name}-{key}" if unchanged(*modules) else None


def _nodes(structure: Any) -> Iterator[Any]:
    """Yield the types of a tree's nodes and the static values in them."""
    if (data := structure.node_data()) is not None:
        yield data[0]
        yield from data[1] if isinstance(data[1], tuple) else ()
    for child in structure.children():
        yield from _nodes(child)


class _Place:
    """Mark where array number `index` stands in the output."""

    def __init__(self, index: int):
        self.index = index


class _Plain:
    """Function of the arrays only; while it is traced, it records the structure of its output."""

    def __init__(self, function: Callable[..., PyTree], structure: Any, static: list, traced: tuple[bool, ...]):
        self.function, self.structure, self.static, self.traced = function, structure, static, traced
        self.skeleton: PyTree = None

    def __call__(self, *arrays):
        values = iter(arrays)
        leaves = [next(values) if is_array else leaf for leaf, is_array in zip(self.static, self.traced, strict=True)]
        out, structure = jax.tree.flatten(self.function(*jax.tree.unflatten(self.structure, leaves)))
        arrays_out = [leaf for leaf in out if eqx.is_array(leaf)]
        places = iter(range(len(arrays_out)))
        self.skeleton = jax.tree.unflatten(
            structure, [_Place(next(places)) if eqx.is_array(leaf) else leaf for leaf in out]
        )
        return arrays_out


# The `_Plain` keeps the function and its static values alive: no other object can take an address that a key contains.
_programs: dict[tuple, tuple[Compiled, PyTree, _Plain]] = {}
_locks: dict[tuple, threading.Lock] = {}
_locks_guard = threading.Lock()


def _stored(path: Path, plain: _Plain, arrays: list) -> tuple[Lowered, PyTree]:
    """Return the program stored at `path`, exported and stored first where it cannot be loaded."""
    try:
        return _load(path, arrays)
    except FileNotFoundError:
        pass
    except Exception as error:  # a damaged file can raise anything
        _warn(path, error)
    exported = jax.export.export(jax.jit(plain), disabled_checks=UNCHECKED)(*arrays)
    content = pickle.dumps((bytes(exported.serialize()), plain.skeleton))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, lambda p: p.write_bytes(content))
        _evict(path.parent)
    except OSError as error:
        _warn(path, error)
    return _lower(content, arrays)


def _load(path: Path, arrays: list) -> tuple[Lowered, PyTree]:
    with path.open("rb") as file:
        if hasattr(os, "getuid") and os.fstat(file.fileno()).st_uid != os.getuid():
            raise PermissionError("it belongs to another user, and loading it could run their code")
        loaded = _lower(file.read(), arrays)
    with suppress(OSError):  # a folder that cannot be written serves all the same
        os.utime(path)  # used now, see `_evict`
    return loaded


def _lower(content: bytes, arrays: list) -> tuple[Lowered, PyTree]:
    serialized, skeleton = pickle.loads(content)
    return jax.jit(jax.export.deserialize(bytearray(serialized)).call).lower(*arrays), skeleton


def _evict(folder: Path) -> None:
    """Delete the programs used least recently until the rest fits into the limit."""
    text, size = os.environ.get(LIMIT, "1000000000"), 0
    if not text.isdecimal():
        raise BadInput(f"environment variable {LIMIT} is '{text}'; give a number of bytes.")
    with suppress(FileNotFoundError):  # another process deletes as well
        for path in sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True):
            size += path.stat().st_size
            if size > int(text):
                path.unlink(missing_ok=True)


_warned = threading.Event()


def _warn(path: Path, error: Exception) -> None:
    """Warn that a stored program cannot be used, once per process."""
    if not _warned.is_set():
        _warned.set()
        words = f"{path}: a compiled program could not be loaded or stored ({error}); it is compiled again instead"
        warnings.warn(words, RuntimeWarning, stacklevel=2)


def clear_program_cache(max_maps: int = 30_000) -> None:
    """Forget all programs of this process if it holds more than `max_maps` memory maps; each takes some hundreds.

    Linux allows a process 65530; beyond that XLA crashes. For workers that meet ever new programs, between tasks.
    """
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > max_maps:
        _programs.clear()
        jax.clear_caches()
