"""`driftjax runs`: what has been run, which laps of all of it meet a condition, and what tells two runs apart."""

import dataclasses
from pathlib import Path
from typing import Any

from driftjax.cli.console import typed
from driftjax.core import require
from driftjax.report import run_line
from driftjax.report.table import aligned, cell
from driftjax.store import list_runs


@dataclasses.dataclass(frozen=True)
class Runs:
    """List run folders, oldest first: time (UTC), verb, car, how far, best mean lateral errors, folder."""

    root: Path = Path("runs")
    """Folder below which to look."""
    where: str | None = None
    """Instead: the laps, of runs of `learn` and of sweeps, for which this SQL condition holds, such as
    "car = 'rc' and lateral_error < 0.05"; an option stands in double quotes, "gp.size"."""
    limit: int = 40
    """Laps shown of those found, best first."""
    compare: tuple[str, str] | None = None
    """Instead: options and figures in which two runs differ, each a run folder or the id of a sweep's trial."""

    def __post_init__(self) -> None:
        require(self.limit >= 1, f"key 'limit' is {self.limit}; give at least 1.")
        require(self.where is None or self.compare is None, "give --where or --compare, not both.")


def run(argv: list[str]) -> int:
    """Lines, or a table."""
    asked = typed(Runs, argv, "driftjax runs")
    if asked.where is not None:
        from driftjax.sweep.query import where

        columns, rows, num = where(asked.root, asked.where, asked.limit)
        _show([tuple(columns), *rows])
        print(f"{num} laps" + (f", the first {asked.limit} shown" if num > asked.limit else ""))
        return 0
    if asked.compare is not None:
        from driftjax.sweep.query import differences, one

        (options_a, figures_a), (options_b, figures_b) = (one(asked.root, name) for name in asked.compare)
        _show([("option", *asked.compare), *differences(options_a, options_b)])
        print()
        _show([("mean", *asked.compare), *differences(figures_a, figures_b)])
        return 0
    lines = [run_line(folder) for folder in list_runs(asked.root)]
    print("\n".join(lines) or f"no runs below {asked.root}")
    return 0


def _show(rows: list[tuple[Any, ...]]) -> None:
    print("\n".join(aligned([tuple(map(cell, row)) for row in rows])))
