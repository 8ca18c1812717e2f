"""`driftjax runs`: list runs, find laps that meet a condition, and compare two runs."""

import dataclasses
from pathlib import Path
from typing import Any

from driftjax.cli.console import parse
from driftjax.core import require, require_at_least
from driftjax.report import run_line
from driftjax.report.table import aligned, cell
from driftjax.store import list_runs


@dataclasses.dataclass(frozen=True)
class RunsOptions:
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
        require_at_least(self, 1, "limit")
        require(self.where is None or self.compare is None, "give --where or --compare, not both.")


def run(argv: list[str]) -> int:
    """Print lines, or a table."""
    flags = parse(RunsOptions, argv, "driftjax runs")
    if flags.where is not None:
        from driftjax.sweep.query import find_laps

        columns, rows, num = find_laps(flags.root, flags.where, flags.limit)
        print_table([tuple(columns), *rows])
        print(f"{num} laps" + (f", the first {flags.limit} shown" if num > flags.limit else ""))
        return 0
    if flags.compare is not None:
        from driftjax.sweep.query import differences, read_run

        (options_a, figures_a), (options_b, figures_b) = (read_run(flags.root, name) for name in flags.compare)
        print_table([("option", *flags.compare), *differences(options_a, options_b)])
        print()
        print_table([("mean", *flags.compare), *differences(figures_a, figures_b)])
        return 0
    lines = [run_line(folder) for folder in list_runs(flags.root)]
    print("\n".join(lines) or f"no runs below {flags.root}")
    return 0


def print_table(rows: list[tuple[Any, ...]]) -> None:
    print("\n".join(aligned([tuple(map(cell, row)) for row in rows])))
