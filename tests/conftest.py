"""Shared settings of the tests: those of the package, and a compilation cache of their own."""

import os
import tempfile
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "driftjax-jax-cache"))


import jax
import pytest

from driftjax.parallel import clear_program_cache

jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


MAPS = 40000  # memory maps above which programs are forgotten


@pytest.fixture(autouse=True, scope="module")
def program_cache_cleared():
    """Forget the programs of earlier modules where they have become many."""
    yield
    clear_program_cache(MAPS)
