"""`driftjax sweep`: many trials of a verb over its options, or those of them that are missing."""

import dataclasses
import shlex
from pathlib import Path

import tyro

from driftjax.cli.console import default_out, parse, progress, run_in
from driftjax.core import require, require_at_least
from driftjax.report.table import aligned
from driftjax.studies.sweepable_verbs import open_verb_sweep
from driftjax.sweep import SweepResult, finish_sweep
from driftjax.sweep.analysis import best_trials


@dataclasses.dataclass(frozen=True)
class SweepOptions:
    """Try many values of a verb's options, each trial once; what a folder holds already is not run again."""

    config: tyro.conf.Positional[Path]
    """YAML: `fields` with their values, `verb`, `base`, `design`, `num`, `objective` ..."""
    out: Path | None = None
    """Folder of the sweep, a new one or one to go on with; runs/sweep-NAME-TIME where left out."""
    workers: int | None = None
    """Processes that run trials side by side; one per core where left out. Results do not depend on it."""
    ray: str | None = None
    """Address of a Ray cluster to run on instead: `auto`, HOST:PORT, or `local` for one on this machine."""
    hosts: bool = False
    """This is one of several processes of a job (Slurm, Open MPI, or JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and
    JAX_PROCESS_ID): each runs a share of the trials, into one `--out` that all see."""

    def __post_init__(self) -> None:
        require_at_least(self, 1, "workers")
        require(not self.hosts or self.out is not None, "--hosts needs --out, a folder that all of them see.")
        require(not self.hosts or self.ray is None, "give --hosts or --ray, not both.")


def run(argv: list[str]) -> int:
    """Run the missing trials, then print the best ones and the shares of the variance."""
    options = parse(SweepOptions, argv, "driftjax sweep")
    opened = open_verb_sweep(options.config, options.out or default_out("sweep", options.config.stem), options.hosts)
    path = opened.folder.path
    resume = f"driftjax sweep {shlex.quote(str(options.config))} --out {shlex.quote(str(path))}"

    def task() -> int:
        print(f"sweep folder: {path}", flush=True)
        with progress() as report:
            return print_result(finish_sweep(opened, workers=options.workers, ray=options.ray, report=report))

    return run_in(opened.folder, task, resume)


def print_result(result: SweepResult) -> int:
    """Print counts, best trials and shares of the variance; returns 1 where no trial is done."""
    counts, config = result.counts, result.analysis.config
    for path in result.damaged:
        print(f"note: {path}: could not be read and was set aside; its trials ran again.", flush=True)
    print(f"{result.num_known} trials were kept from before, {counts.total()} ran, {counts['failed']} of these failed")
    table = best_trials(result.folder.results)
    print("\n".join(aligned(table)) if table else "no trial has a result in every row looked at")
    if result.shares:
        head = ("", f"share of the variance of {config.objective}", "95 % interval")
        rows = sorted(result.shares.items(), key=lambda item: -item[1][0])
        cells = [(name, f"{share:.2f}", f"[{low:.2f}, {high:.2f}]") for name, (share, low, high) in rows]
        print("\n".join(["", *aligned([head, *cells])]))
    print(f"sweep: {result.folder.path}")
    if not result.analysis.status.get("done"):
        print(f"next: no trial is done; {result.folder.path / 'errors'} says why.")
        return 1
    figures = result.folder.path / "figures"
    print(f"next: see {figures}, and run `driftjax {config.verb}` with the options of the best trial.")
    return 0
