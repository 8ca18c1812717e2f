"""Peers that may not be there."""

import importlib.util
import shutil
from typing import Literal

Solver = Literal["fatrop", "ipopt"]
PEERS: dict[Solver, str] = {"fatrop": "CasADi FATROP", "ipopt": "CasADi IPOPT"}


def missing(package: str) -> str:
    """How to install a Python package or a program that is not there; empty where it is."""
    if package == "g++":
        return "" if shutil.which("g++") else "missing: install g++"
    names = {"scikit-learn": "sklearn"}
    there = importlib.util.find_spec(names.get(package, package)) is not None
    return "" if there else f"missing: pip install {package}"
