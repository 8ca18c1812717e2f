"""Optional peers."""

import importlib.util
import shutil
from typing import Literal

Solver = Literal["fatrop", "ipopt"]
PEERS: dict[Solver, str] = {"fatrop": "CasADi FATROP", "ipopt": "CasADi IPOPT"}


def missing(package: str) -> str:
    """Return how to install a missing Python package or program; empty if it is installed."""
    if package == "g++":
        return "" if shutil.which("g++") else "missing: install g++"
    names = {"scikit-learn": "sklearn"}
    there = importlib.util.find_spec(names.get(package, package)) is not None
    return "" if there else f"missing: pip install {package}"
