"""Run a whole sweep from Python: its folder, the missing trials, the analysis and the figures."""

import os
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import jax

from driftjax.core import BadInput, require
from driftjax.core.config import to_dict
from driftjax.core.progress import ProgressReport
from driftjax.environment import fuses_results
from driftjax.parallel import num_cores
from driftjax.store import RunFolder
from driftjax.sweep.analysis import Analysis, Shares, analyse, sensitivity, to_json
from driftjax.sweep.config import SweepConfig
from driftjax.sweep.engine import devices, run_trials
from driftjax.sweep.executors import open_executor
from driftjax.sweep.figures import write_figures
from driftjax.sweep.optuna_source import OptunaSource
from driftjax.sweep.source import DesignSource
from driftjax.sweep.store import Store
from driftjax.sweep.trial import Work

WAIT = 120  # for the folder of the first process [s]


@dataclass(frozen=True)
class SweepResult:
    """Result of a sweep, that of earlier calls included."""

    folder: RunFolder
    analysis: Analysis
    shares: Shares | None  # of the objective's variance; None of too few trials
    num_known: int  # trials that the folder held already
    counts: Counter[str]  # trials run now, by status
    damaged: tuple[Path, ...]  # files that could not be read; their trials ran again


@dataclass(frozen=True)
class OpenSweep:
    """Folder and store of a sweep whose trials can be run."""

    config: SweepConfig
    folder: RunFolder
    store: Store
    share: tuple[int, int]  # index of this process and number of processes


def open_sweep(config: SweepConfig, work: Work, out: Path, hosts: bool = False) -> OpenSweep:
    """Create or open the folder of a sweep; nothing runs yet.

    `work` runs one trial, such as `driftjax.studies.sweepable_verbs.WORKS[config.verb]`. With `hosts` this is one of
    several processes of a job, each with a share of the trials. Raises `BadInput` where `out` holds another sweep.
    """
    share = join_hosts() if hosts else (0, 1)
    require(share[1] == 1 or config.design != "optuna", "--hosts: use --ray, or workers, for a design by Optuna.")
    store = Store(out, config, work)
    return OpenSweep(config, open_folder(out, config) if share[0] == 0 else wait_for_folder(out), store, share)


def finish_sweep(
    opened: OpenSweep,
    *,
    workers: int | None = None,
    ray: str | None = None,
    report: ProgressReport = lambda text, done, total: None,
) -> SweepResult:
    """Run the missing trials, then analyse all trials; writes results.json and figures.

    `workers` processes run side by side, one per core where left out; `ray` is the address of a cluster instead.
    """
    config, folder, store = opened.config, opened.folder, opened.store
    num = workers or (1 if devices() is not None else num_cores())  # devices are filled by this process
    with store.locked(opened.share[0]):
        known, damaged = store.known_trials()
        optuna = config.design == "optuna"
        source = OptunaSource(config, store.work, store) if optuna else (
            DesignSource(config, store.work, known, opened.share))  # fmt: skip
        fused = store.work.fused and fuses_results() and devices() is None
        with open_executor(num if num > 1 or fused else 0, ray, devices() is not None, fused) as running:
            counts = run_trials(config, store.work, store, source, running, report)
        analysis = analyse(store, config)
        shares = sensitivity(analysis)
        folder.write_json("results", to_json(analysis, shares))
        write_figures(analysis, shares, folder.path / "figures")
    return SweepResult(folder, analysis, shares, source.num_known, counts, tuple(damaged))


def join_hosts() -> tuple[int, int]:
    """Wait for all processes of the job; return the index of this one and how many there are."""
    variables = (os.environ.get("JAX_NUM_PROCESSES"), os.environ.get("JAX_PROCESS_ID"))
    try:  # JAX finds all three by itself under Slurm and Open MPI, and the address in the environment
        num, this = (None if value is None else int(value) for value in variables)
        jax.distributed.initialize(num_processes=num, process_id=this)
    except (ValueError, RuntimeError) as error:
        words = " ".join(str(error).split())[:200]
        raise BadInput(f"--hosts: {words}; start it under Slurm or Open MPI, or set JAX_COORDINATOR_ADDRESS, "
                       "JAX_NUM_PROCESSES and JAX_PROCESS_ID.") from None  # fmt: skip
    return jax.process_index(), jax.process_count()


def wait_for_folder(out: Path) -> RunFolder:
    """Wait for the folder that the first process creates, and open it."""
    for _ in range(WAIT):
        if (out / "config.yaml").exists():
            return RunFolder.open(out)
        time.sleep(1.0)
    raise BadInput(f"{out}: the first process has not made it within {WAIT} s; give an --out that all of them see.")


def open_folder(out: Path, config: SweepConfig) -> RunFolder:
    """Create the folder, or open that of an earlier sweep over the same verb and fields."""
    plain = to_dict(config)
    folder = RunFolder.ensure(out, plain, "sweep")
    if any(folder.config.get(key) != plain[key] for key in ("verb", "base", "fields")):
        raise BadInput(f"{out}: holds a sweep over other fields or options; give another folder (--out).")
    return folder
