"""Shared settings of the tests: those of the package, and a compilation cache of their own."""

import gc
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
# Tests compile more than they run: without LLVM's optimisations, in one part and with XLA's older emitters of fused
# loops, a program compiles in a third of the time. Flags that are given come last and win.
FLAGS = (
    "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1 --xla_cpu_use_fusion_emitters=false"
)
os.environ.setdefault("DRIFTJAX_FUSED_RESULTS", "0")  # which these emitters do not know
os.environ["XLA_FLAGS"] = f"{FLAGS} {os.environ.get('XLA_FLAGS', '')}"
# Functions whose programs run for longer than they compile.
LONG = (
    "drive_batch solve_from _expansion batched_rollouts sample_derivatives observe_runs propagate_pieces predict_ahead "
    "batched_residuals batched_derivatives likelihoods _riccatis by_commands"
)
os.environ.setdefault("DRIFTJAX_OPTIMISED", LONG.replace(" ", ","))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy is here before the package, which sets it else
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(SCRATCH / "driftjax-jax-cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
gc.set_threshold(50_000, 20, 100)  # traces are large and mostly live: to look at them less often saves a twentieth

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
