"""`driftjax runs`: what has been run."""

import dataclasses
from pathlib import Path

from driftjax.cli.console import typed
from driftjax.data import list_runs
from driftjax.report import run_line


@dataclasses.dataclass(frozen=True)
class Runs:
    """List run folders, oldest first: time (UTC), verb, car, how far, best mean lateral errors, folder."""

    root: Path = Path("runs")
    """Folder below which to look."""


def run(argv: list[str]) -> int:
    """One line per run."""
    root = typed(Runs, argv, "driftjax runs").root
    lines = [run_line(folder) for folder in list_runs(root)]
    print("\n".join(lines) or f"no runs below {root}")
    return 0
