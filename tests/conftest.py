"""Shared settings of the tests: those of the package, and a compilation cache of their own."""

import os
import sys
import tempfile
from pathlib import Path

import pytest

# Settings come first: the workers of the tests and the processes that tests start inherit them.
SCRATCH = Path(tempfile.gettempdir())
if sys.dont_write_bytecode:  # else each of these processes compiles 1700 modules, jax's among them
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(SCRATCH / "driftjax-pycache")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(SCRATCH / "driftjax-jax-cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")


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
    from driftjax.parallel import clear_program_cache  # not above: the process that starts the workers needs no jax

    clear_program_cache(MAPS)
