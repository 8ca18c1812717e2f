"""Plot a log as it was read: every channel over time, one run after the other, with its gaps."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from driftjax.logs import Run
from driftjax.report.style import GPR, new_figure, save

DEG = 180 / np.pi
ROWS = (("V", "speed V [m/s]", 1.0), ("beta", "sideslip beta [deg]", DEG), ("r", "yaw rate r [deg/s]", DEG),
        ("delta", "steering delta [deg]", DEG), ("Fxr", "drive force Fxr [N]", 1.0))  # fmt: skip
POINTS = 4000  # of a curve at most


def write_inspection(runs: Sequence[Run], folder: Path) -> list[Path]:
    """Write the figure into `folder`/figures; returns its path."""
    figure, axes = new_figure(len(ROWS), 1, (9.0, 8.5), sharex=True)
    starts = np.cumsum([0.0, *(len(run.t) * run.dt for run in runs)])
    every = max(sum(len(run.t) for run in runs) // POINTS, 1)
    for axis, (name, label, factor) in zip(axes[:, 0], ROWS, strict=True):
        for start, run in zip(starts, runs, strict=False):
            axis.plot(start + run.t[::every] - run.t[0], factor * getattr(run, name)[::every], color=GPR, lw=0.9)
            axis.axvline(start, color="0.6", lw=0.5)
        axis.set_ylabel(label)
        axis.margins(x=0)
    axes[-1, 0].set_xlabel("time, run after run [s]")
    return [save(figure, folder / "figures", "channels")]
