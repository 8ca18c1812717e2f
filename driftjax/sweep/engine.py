"""Run the trials of a sweep in chunks on executors, and store every outcome as it arrives."""

from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from itertools import islice
from pathlib import Path

import jax

from driftjax.core.progress import ProgressReport
from driftjax.parallel import BatchExecutor, DeviceExecutor, clear_program_cache, run_together
from driftjax.sweep.config import SweepConfig
from driftjax.sweep.executors import ChunkExecutor
from driftjax.sweep.source import Source
from driftjax.sweep.store import Store
from driftjax.sweep.trial import Outcome, Trial, Work, run_trial

CHUNK_SECONDS, LARGEST = 3.0, 256  # a chunk is what is lost when a worker dies, and one file of the store
BATCH, AT_ONCE = 256, 4  # trials in one batch on devices; trials chosen at once where they follow results
KILLS = 2  # workers that a trial may take with it where it runs alone


def run_trials(
    config: SweepConfig, work: Work, store: Store, source: Source, executor: ChunkExecutor, report: ProgressReport
) -> Counter:
    """Run the trials that the store lacks; returns the number of trials run now by status."""
    state = _Run(config, work, store, source, executor, report)
    state.all()
    return state.counts


class _Run:
    def __init__(
        self,
        config: SweepConfig,
        work: Work,
        store: Store,
        source: Source,
        executor: ChunkExecutor,
        report: ProgressReport,
    ):
        self.config, self.work, self.store = config, work, store
        self.source, self.executor, self.report = source, executor, report
        self.counts: Counter[str] = Counter()
        self._running: dict[Future, list[Trial]] = {}
        self._next: list[Trial] = []  # taken from the source; submitting them may fail
        self._suspects: list[Trial] = []  # that ran when a worker died: one of them may be to blame
        self._kills: Counter[str] = Counter()
        self._trial_seconds = CHUNK_SECONDS

    def all(self) -> None:
        trials = self.source.trials()
        self._report()
        while True:
            try:
                self._fill(trials)
                if not self._running:
                    return
                for future in wait(self._running, return_when=FIRST_COMPLETED).done:
                    self._arrived(future.result())
                    del self._running[future]
            except BrokenProcessPool:
                self._broken()
            self._report()

    def _fill(self, trials: Iterator[Trial]) -> None:
        """Keep the executor busy; trials suspected of killing workers run alone."""
        while len(self._running) < (1 if self._suspects else self.executor.slots):
            if self._suspects:
                chunk = [self._suspects[-1]]
            else:
                chunk = self._next = self._next or list(islice(trials, self._size()))
            if not chunk:
                return
            args = (self.work, chunk, self.store.path, self.config, self.source.watcher)
            self._running[self.executor.submit(run_chunk, *args)] = chunk
            if not self._suspects:
                self._next = []

    def _size(self) -> int:
        """Return the chunk size: trials that take `CHUNK_SECONDS`, or a batch; few where trials depend on results."""
        most = BATCH if self.executor.batched else max(1, min(LARGEST, int(CHUNK_SECONDS / self._trial_seconds)))
        return min(most, AT_ONCE) if self.source.adaptive else most

    def _arrived(self, outcomes: list[Outcome]) -> None:
        self.store.add(outcomes)
        for outcome in outcomes:
            self.source.record(outcome)
            self.counts[outcome.status] += 1
            self._suspects = [trial for trial in self._suspects if trial.id != outcome.trial.id]
        self._trial_seconds = max(1e-3, sum(outcome.seconds for outcome in outcomes) / len(outcomes))

    def _broken(self) -> None:
        """Restart the pool after a worker died: one of the trials that ran may be the cause."""
        chunks = list(self._running.values())
        self._running.clear()
        self.executor.restart()
        if not self._suspects:
            self._suspects = [trial for chunk in chunks for trial in chunk]
            return
        for [alone] in chunks:  # at most one; none where the pool was found broken before it ran
            self._kills[alone.id] += 1
            if self._kills[alone.id] == KILLS:
                words = f"its worker process was killed {KILLS} times; it may want more memory than there is"
                self._arrived([Outcome(alone, "failed", words, 0.0, [])])

    def _report(self) -> None:
        total, kept = self.source.total, self.source.num_known + self.counts.total()
        first = kept < total and not self.counts
        self.report("first trials, which compile" if first else f"{self.counts['failed']} failed", kept, total)


def run_chunk(
    work: Work, trials: list[Trial], folder: Path, config: SweepConfig, watcher: Callable | None
) -> list[Outcome]:
    """Run trials in this process, one after the other or as one batch on its `devices`; returns their outcomes."""

    def task(trial: Trial) -> Callable[[BatchExecutor], Outcome]:
        watch = watcher(trial, config) if watcher else None
        return lambda executor: run_trial(work, trial, executor, folder / "work", config, watch)

    clear_program_cache()
    tasks, batch = [task(trial) for trial in trials], devices()
    return [one(BatchExecutor(1)) for one in tasks] if batch is None else run_together(batch, tasks)


@cache
def devices() -> DeviceExecutor | None:
    """Return all devices of this process for a batch of trials; None for a single CPU, where batches gain nothing."""
    cpu = jax.default_backend() == "cpu"
    return None if cpu and len(jax.local_devices()) == 1 else DeviceExecutor(1 if cpu else None)
