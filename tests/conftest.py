"""Shared settings of the tests: float64, the persistent compilation cache, one device thread."""

import os
import tempfile
from pathlib import Path

from driftjax import WHOLE_LOOPS

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("NPROC", "1")  # XLA's CPU client with two or more threads can deadlock on LAPACK calls
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads inside each small batched factorisation cost 10x
# As the command line: loops cut into parts for threads round otherwise than whole ones.
os.environ.setdefault("XLA_FLAGS", WHOLE_LOOPS)

import jax
import pytest

from driftjax.parallel import clear_program_cache

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_enable_async_dispatch", False)
jax.config.update("jax_compilation_cache_dir", os.environ.get(
    "JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "driftjax-jax-cache")))  # fmt: skip
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


MAPS = 40000  # memory maps above which programs are forgotten


@pytest.fixture(autouse=True, scope="module")
def program_cache_cleared():
    """Forget the programs of earlier modules where they have become many."""
    yield
    clear_program_cache(MAPS)
