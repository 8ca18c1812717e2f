"""Shared settings of the tests: those of the package, and a compilation cache of their own."""

import os
import tempfile
from pathlib import Path

# XLA's older emitters of fused loops compile in two thirds of the time; their loops run a fifth slower.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "driftjax-jax-cache"))


import jax
import pytest

from driftjax.parallel import clear_program_cache

jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


# Files that compile what others load: begun first, one on each worker, and the others that share their programs last.
COMPILING = ("learning/test_loop.py", "studies/hidden_effects/test_hidden_effects.py")
SHARING = ("sweep/test_sweep_cli.py", "diagnosis/", "experiments/test_examples.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files so that no two workers compile the same programs at the same time."""

    def rank(item: pytest.Item) -> int:
        name = item.path.relative_to(Path(__file__).parent).as_posix()
        return -1 if name in COMPILING else int(name.startswith(SHARING))

    items.sort(key=rank)


MAPS = 40000  # memory maps above which programs are forgotten


@pytest.fixture(autouse=True, scope="module")
def program_cache_cleared():
    """Forget the programs of earlier modules where they have become many."""
    yield
    clear_program_cache(MAPS)
