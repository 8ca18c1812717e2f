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

from driftjax.core.programs import let_go

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_enable_async_dispatch", False)
jax.config.update("jax_compilation_cache_dir", os.environ.get(
    "JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "driftjax-jax-cache")))  # fmt: skip
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


# Files that compile what others load: begun first, one on each worker, and the others that share their programs last.
COMPILING = ("learn/test_loop.py", "diagnose/test_hidden_effects.py")
SHARING = ("sweep/test_sweep_cli.py", "diagnose/")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files so that no two workers compile the same programs at the same time."""

    def rank(item: pytest.Item) -> int:
        name = item.path.relative_to(Path(__file__).parent).as_posix()
        return -1 if name in COMPILING else int(name.startswith(SHARING))

    items.sort(key=rank)


MAPS = 40000  # memory maps from which programs are given up


@pytest.fixture(autouse=True, scope="module")
def programs_let_go():
    """Programs of earlier modules are given up where they have become many."""
    yield
    let_go(MAPS)
