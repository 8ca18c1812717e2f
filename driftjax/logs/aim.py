"""Read AiM logs (.xrk, .xrz) with libxrk, in a process of its own."""

from pathlib import Path

import numpy as np

from driftjax.logs.extras import import_extra, unreadable
from driftjax.logs.isolated import read_isolated
from driftjax.logs.series import Series, pick_channels

KIND = "AiM file"
MAGIC = b"<hCNF"
DEFLATED = (b"\x78\x01", b"\x78\x9c", b"\x78\xda")  # .xrz
REMEDY = "read it out of the logger again"
SCRIPT = Path(__file__).with_name("aim_process.py")


def is_aim(path: Path, start: bytes) -> bool:
    """Return whether a file with these first bytes is an AiM log."""
    return start.startswith(MAGIC) or (path.suffix.lower() == ".xrz" and start.startswith(DEFLATED))


def aim_channels(path: Path) -> dict[str, str]:
    """Return the unit of every channel."""
    return {name: unit for name, unit, _ in _read(path)}


def aim_series(path: Path, names: list[str]) -> dict[str, Series]:
    """Return the channels `names`; time counts from the start of the log."""
    return pick_channels(path, names, [(name, series) for name, _, series in _read(path)])


def _read(path: Path) -> list[tuple[str, str, Series]]:
    """Return name, unit and samples of every channel."""
    import_extra(path, f"an {KIND}", "aim", "libxrk")
    arrays = read_isolated(SCRIPT, path, KIND, REMEDY)
    parts = [(arrays[f"name{k}"], arrays[f"t{k}"], arrays[f"y{k}"]) for k in range(len(arrays) // 3)]
    if not parts:
        raise unreadable(path, KIND, "it holds no channel with samples", REMEDY)
    return [(str(name[0]), str(name[1]), Series(_clock(t), t, y)) for name, t, y in parts]


def _clock(t: np.ndarray) -> str:
    """Return a name for the time stamps, the same for channels that share them."""
    return f"{len(t)} samples from {t[0]:g} to {t[-1]:g} s" if len(t) else "no samples"
