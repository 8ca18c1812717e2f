"""Process settings to make before JAX computes: double precision, one thread per program, a compilation cache.

`import driftjax` calls `setup()`. JAX need not be imported for it, so that `driftjax --help` stays fast.
"""

import importlib.util
import os
import sys
import warnings
from pathlib import Path

__version__ = "0.1.0"

# Passes of XLA. One cuts loops into parts for threads, which round otherwise than on one thread.
SERIAL_LOOPS = "cpu-parallel-task-assigner"
# One drops optimisation barriers before loops are merged on a CPU. Where they are kept, values that several loops read
# are computed once (`solve.compute_once`): programs of the MPC compile and run in two thirds of the time. The other
# makes one kernel of a short loop, which cannot hold barriers.
BARRIERS = ("cse_barrier_expander", "small-while-loop-hoisting")
DISABLE = "--xla_disable_hlo_passes="
# XLA's flag for kernels with several results, with which laps compile and run twice as fast on a CPU. It is for our own
# processes only: jaxlib 0.10.2 aborts on programs whose results differ in rank, L-BFGS-B of jaxopt among them.
FUSED_RESULTS = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true"
FUSED = "DRIFTJAX_FUSED_RESULTS"  # environment variable; 0 does without that flag
CACHE = "~/.cache/driftjax"


def setup(*, cache: str | Path | None = None, threads: int | None = None) -> None:
    """Set up JAX for this package: float64, compiled programs kept on disk, `threads` per program.

    `cache` is the folder of compiled programs; left out, it is the one that JAX has been given,
    `JAX_COMPILATION_CACHE_DIR` or ~/.cache/driftjax.
    `threads` is the number of threads of XLA's CPU client; left out, it is `NPROC` or 1: with two or more, LAPACK
    calls in one program can deadlock (seen with jaxlib 0.10.2), and batches of laps are as fast with one.

    JAX reads the number of threads once, when it starts its CPU client. Raises `RuntimeError` where `threads` is
    given after that, and warns where the client was started before this package was imported.
    """
    values = {
        "jax_enable_x64": True,
        "jax_persistent_cache_min_compile_time_secs": 0.0,  # hundreds of small programs add up
        "jax_compilation_cache_dir": _cache_folder(cache),
    }
    _set_threads_and_passes(threads)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads inside each small batched factorisation cost 10x
    os.environ |= {name.upper(): str(value) for name, value in values.items()}  # for this JAX and those of workers
    if "jax" in sys.modules:  # it has read its environment already
        import jax

        for name, value in values.items():
            jax.config.update(name, value)


def dispatch_inline() -> None:
    """Run CPU programs in the calling thread, as parallel threads need; no environment variable sets this."""
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)


def require_float64() -> None:
    """Raise `RuntimeError` where JAX computes in single precision, in which equilibria and GPs are not solved."""
    import jax

    if not jax.config.values["jax_enable_x64"]:
        raise RuntimeError("JAX computes in float32 here; call driftjax.setup(), or leave jax_enable_x64 on.")


def _cache_folder(cache: str | Path | None) -> str:
    chosen = sys.modules["jax"].config.values["jax_compilation_cache_dir"] if "jax" in sys.modules else None
    return os.path.expanduser(str(cache or chosen or os.environ.get("JAX_COMPILATION_CACHE_DIR") or CACHE))


def _set_threads_and_passes(threads: int | None) -> None:
    started = _client_started()
    if threads is not None:
        if started and os.environ.get("NPROC") != str(threads):
            raise RuntimeError("JAX has started already; call driftjax.setup(threads=...) before anything computes.")
        os.environ["NPROC"] = str(threads)
    elif started and "NPROC" not in os.environ:
        warnings.warn(
            "JAX computed before driftjax was imported and may use several threads, with which LAPACK calls can "
            "deadlock; import driftjax first, or set NPROC=1.",
            RuntimeWarning,
            stacklevel=3,
        )
        return
    serial = os.environ.setdefault("NPROC", "1") == "1"
    passes = [*([SERIAL_LOOPS] if serial else []), *(BARRIERS if _on_cpu_only() else [])]
    if passes:
        os.environ["XLA_FLAGS"] = without_passes(os.environ.get("XLA_FLAGS", ""), *passes)


def _on_cpu_only() -> bool:
    """Return whether JAX has no other device than CPUs, without importing it: other backends may need the pass."""
    others = ("jax_plugins", "libtpu")
    return os.environ.get("JAX_PLATFORMS") == "cpu" or not any(map(importlib.util.find_spec, others))


def without_passes(flags: str, *names: str) -> str:
    """Return XLA's flags with more compiler passes disabled."""
    return _with_disabled(flags, list(dict.fromkeys([*_disabled(flags), *names])))


def with_pass(flags: str, name: str) -> str:
    """Return XLA's flags without one that disables this compiler pass."""
    return _with_disabled(flags, [other for other in _disabled(flags) if other != name])


def _disabled(flags: str) -> list[str]:
    return [
        name for flag in flags.split() if flag.startswith(DISABLE) for name in flag.removeprefix(DISABLE).split(",")
    ]


def _with_disabled(flags: str, names: list[str]) -> str:
    """Return the flags with one that disables these passes: of several, XLA reads the last only."""
    others = [flag for flag in flags.split() if not flag.startswith(DISABLE)]
    return " ".join([*others, *([DISABLE + ",".join(names)] if names else [])])


def add_flag(flag: str) -> None:
    """Add a flag to those that XLA reads when its client starts."""
    os.environ["XLA_FLAGS"] = with_flag(os.environ.get("XLA_FLAGS", ""), flag)


def with_flag(flags: str, flag: str) -> str:
    """Return XLA's flags with one more, if they lack it."""
    return flags if flag in flags.split() else f"{flags} {flag}".strip()


def fuses_results() -> bool:
    """Return whether processes of our own may use `FUSED_RESULTS`."""
    return os.environ.get(FUSED, "1") != "0"


def _client_started() -> bool:
    """Return whether JAX has a backend in this process, without importing JAX."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bool(bridge and bridge.backends_are_initialized())
