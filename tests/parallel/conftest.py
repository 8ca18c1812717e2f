"""Fixtures of the tests of stored programs."""

import jax
import pytest


@pytest.fixture
def empty_cache(tmp_path):
    """An empty compilation cache: what an earlier run has stored is not loaded."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)
