"""`driftjax sweep`: many trials of a verb over its options, or those of them that are missing."""

import dataclasses
import os
import shlex
import time
from collections import Counter
from pathlib import Path

import jax
import tyro

from driftjax.cli.console import default_out, progress, typed, within
from driftjax.core import BadInput, require
from driftjax.core.config import to_dict
from driftjax.parallel import num_cores
from driftjax.report.table import aligned
from driftjax.store import RunFolder
from driftjax.studies.sweepable_verbs import WORKS
from driftjax.sweep import Laid, Store, SweepConfig, check, executor, load_sweep, sweep
from driftjax.sweep.analysis import see, sensitivity, to_json, words
from driftjax.sweep.engine import devices
from driftjax.sweep.figures import write_figures
from driftjax.sweep.optuna_source import Chosen

WAIT = 120  # for the folder of another process [s]


@dataclasses.dataclass(frozen=True)
class Sweep:
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
    JAX_PROCESS_ID): each runs a share of the trials, into one --out that all see."""

    def __post_init__(self) -> None:
        require(self.workers is None or self.workers >= 1, f"key 'workers' is {self.workers}; give at least 1.")
        require(not self.hosts or self.out is not None, "--hosts needs --out, a folder that all of them see.")
        require(not self.hosts or self.ray is None, "give --hosts or --ray, not both.")


def run(argv: list[str]) -> int:
    """Run what is missing; tables and figures of all."""
    asked = typed(Sweep, argv, "driftjax sweep")
    share = joined_hosts() if asked.hosts else (0, 1)
    config = load_sweep(asked.config)
    require(share[1] == 1 or config.design != "optuna", "--hosts: use --ray, or workers, for a design by Optuna.")
    work = WORKS[config.verb]
    try:
        check(config, work)
    except BadInput as error:
        raise BadInput(f"{asked.config}: {error}") from None
    out = asked.out or default_out("sweep", asked.config.stem)
    store = Store(out, config, work)
    folder = opened(out, config) if share[0] == 0 else awaited(out)
    again = f"driftjax sweep {shlex.quote(str(asked.config))} --out {shlex.quote(str(out))}"
    batch = devices() is not None  # several devices, or a GPU: this process fills them
    num = asked.workers or (1 if batch else num_cores())
    with store.locked(share[0]):
        return within(folder, lambda: all_of(config, store, folder, share, num if num > 1 else 0, asked.ray), again)


def joined_hosts() -> tuple[int, int]:
    """Which process of how many this is, once all of them are there."""
    given = (os.environ.get("JAX_NUM_PROCESSES"), os.environ.get("JAX_PROCESS_ID"))
    try:  # JAX finds all three by itself under Slurm and Open MPI, and the address in the environment
        num, this = (None if value is None else int(value) for value in given)
        jax.distributed.initialize(num_processes=num, process_id=this)
    except (ValueError, RuntimeError) as error:
        words = " ".join(str(error).split())[:200]
        raise BadInput(f"--hosts: {words}; start it under Slurm or Open MPI, or set JAX_COORDINATOR_ADDRESS, "
                       "JAX_NUM_PROCESSES and JAX_PROCESS_ID.") from None  # fmt: skip
    return jax.process_index(), jax.process_count()


def awaited(out: Path) -> RunFolder:
    """The folder that the first process makes."""
    for _ in range(WAIT):
        if (out / "config.yaml").exists():
            return RunFolder.open(out)
        time.sleep(1.0)
    raise BadInput(f"{out}: the first process has not made it within {WAIT} s; give an --out that all of them see.")


def opened(out: Path, config: SweepConfig) -> RunFolder:
    """The folder, a new one or that of an earlier sweep over the same verb and fields."""
    plain = to_dict(config)
    if not (out / "config.yaml").exists():
        return RunFolder.create(out, plain, "sweep")
    folder = RunFolder.open(out)
    if folder.verb != "sweep":
        raise BadInput(f"{out}: a run of `driftjax {folder.verb}`, not of `driftjax sweep`; give another --out.")
    same = all(folder.config.get(key) == plain[key] for key in ("verb", "base", "fields"))
    if not same:
        raise BadInput(f"{out}: holds a sweep over other fields or options; give another --out.")
    return folder


def all_of(
    config: SweepConfig, store: Store, folder: RunFolder, share: tuple[int, int], workers: int, ray: str | None
) -> int:
    """Run what is missing and tell what came out; 1 where no trial has come to its end."""
    print(f"sweep folder: {store.path}", flush=True)
    known, damaged = store.known()
    for path in damaged:
        print(f"note: {path}: could not be read and was set aside; its trials run again.", flush=True)
    source = Chosen(config, store.work, store) if config.design == "optuna" else Laid(config, store.work, known, share)
    with executor(workers, ray, devices() is not None) as executed, progress() as report:
        counts: Counter[str] = sweep(config, store.work, store, source, executed, report)
    print(f"{source.kept} trials were kept from before, {counts.total()} ran, {counts['failed']} of these failed")
    return tell(folder, store, config)


def tell(folder: RunFolder, store: Store, config: SweepConfig) -> int:
    """results.json, figures, and the best trials on the terminal."""
    seen = see(store, config)
    shares = sensitivity(seen)
    folder.write_json("results", found := to_json(seen, shares))
    write_figures(seen, shares, folder.path / "figures")
    print("\n".join(aligned(words(found))) if found["best"] else "no trial has a result in every row looked at")
    if shares:
        head = ("", f"share of the variance of {config.objective}", "95 % interval")
        rows = sorted(shares.items(), key=lambda item: -item[1][0])
        print(
            "\n".join(["", *aligned([head, *((name, f"{v:.2f}", f"[{l:.2f}, {h:.2f}]") for name, (v, l, h) in rows)])])
        )
    print(f"sweep: {folder.path}")
    return 0 if seen.status.get("done") else 1
