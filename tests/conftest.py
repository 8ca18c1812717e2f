"""Shared settings of the tests: those of the package, and a compilation cache of their own."""

import os
import tempfile
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "driftjax-jax-cache"))


import jax
import pytest

from driftjax.core.programs import let_go

jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)

MAPS = 40000  # memory maps from which programs are given up


@pytest.fixture(autouse=True, scope="module")
def programs_let_go():
    """Programs of earlier modules are given up where they have become many."""
    yield
    let_go(MAPS)
