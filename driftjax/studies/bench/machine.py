"""Describe the machine and the versions behind the numbers."""

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import jax

from driftjax.store.versions import package_version, versions

PACKAGES = ("casadi", "numba", "scikit-learn", "scipy")


def machine() -> dict[str, Any]:
    """Return processor, cores, device, versions of both sides and date."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "host": platform.node(),
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,  # others slow both sides
        "devices": [f"{device.platform}: {device.device_kind}" for device in jax.devices()],
        "versions": versions() | {name: package_version(name) for name in PACKAGES} | {"g++": _compiler("g++")},
    }


def _processor() -> str:
    """Return the name of the processor, which many systems give in /proc/cpuinfo only."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _compiler(name: str) -> str | None:
    try:
        return subprocess.run([name, "-dumpfullversion"], capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
