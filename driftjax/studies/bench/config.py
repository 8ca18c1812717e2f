"""Options of the bench, and its optional peers."""

import dataclasses
import importlib.util
import shutil
from dataclasses import dataclass
from typing import Literal

from driftjax.core import require, require_at_least

Part = Literal["mpc", "controller", "simulator", "gp", "plan", "laps", "compile"]
PARTS: tuple[Part, ...] = ("mpc", "controller", "simulator", "gp", "plan", "laps", "compile")
Dtype = Literal["float64", "float32"]
Solver = Literal["fatrop", "ipopt"]
PEERS: dict[Solver, str] = {"fatrop": "CasADi FATROP", "ipopt": "CasADi IPOPT"}


@dataclass(frozen=True)
class BenchConfig:
    """Measure every fast part as a ratio against a peer in the same run."""

    only: tuple[Part, ...] = PARTS
    """Parts to measure."""
    quick: bool = False
    """Every row with tiny sizes and few repeats, in float64, without the compilations: shows that it runs, no more."""
    dtype: tuple[Dtype, ...] = ("float64", "float32")
    """Precisions of the MPC and the simulator; all else is in float64."""
    batch: int = 256
    """MPC problems, and closed-loop laps, side by side."""
    cars: int = 65536
    """Simulated cars side by side."""
    repeats: int = 7
    """Runs of each measurement; three of those that take minutes."""
    threads: int = 2
    """CPU threads of the batched MPC and of the simulator; peers use one. No effect on a GPU."""
    workers: int = 2
    """Processes of the closed-loop laps; 0 on a GPU."""
    plots: bool = True
    """Measure and draw how the costs grow with batch, horizon, and size of the Gaussian process."""

    def __post_init__(self) -> None:
        require(len(self.only) > 0, "key 'only' is empty; name at least one part.")
        require(len(self.dtype) > 0, "key 'dtype' is empty; name at least one.")
        require_at_least(self, 1, "batch", "cars", "repeats", "threads")
        require_at_least(self, 0, "workers")

    def reduced(self) -> "BenchConfig":
        """Return the options with the sizes of `quick`."""
        only = tuple(part for part in self.only if part != "compile")
        require(len(only) > 0, "the part 'compile' takes minutes and has no quick form; leave out --quick.")
        small = {"dtype": ("float64",), "batch": 1, "cars": 256, "repeats": 2, "threads": 1, "workers": 0}
        return dataclasses.replace(self, only=only, **small)


def missing(package: str) -> str:
    """Return how to install a missing Python package or program; empty if it is installed."""
    if package == "g++":
        return "" if shutil.which("g++") else "missing: install g++"
    names = {"scikit-learn": "sklearn"}
    there = importlib.util.find_spec(names.get(package, package)) is not None
    return "" if there else f"missing: pip install {package}"
