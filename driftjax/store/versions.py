"""Record the versions that produced a run."""

import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax

from driftjax.environment import __version__

PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "numpy")


def versions() -> dict[str, str | None]:
    """Return the versions of packages and Python, machine, device, commit and time."""
    packages: dict[str, str | None] = {"driftjax": __version__} | {name: package_version(name) for name in PACKAGES}
    return packages | {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "device": f"{jax.default_backend()}: {jax.devices()[0].device_kind}",
        "commit": commit(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def package_version(name: str) -> str | None:
    """Return the version of an installed package; None if it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def commit() -> str | None:
    """Return the Git commit of the running checkout, with `+changes` if files differ; None outside a checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    git = ["git", "-C", str(root)]
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        changes = subprocess.run([*git, "status", "--porcelain", "-uno"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.stdout.strip() + ("+changes" if changes.stdout.strip() else "")
