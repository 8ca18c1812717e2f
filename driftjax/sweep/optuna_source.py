"""Trials suggested by Optuna as results arrive (Akiba et al. 2019)."""

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

from driftjax.core import BadInput
from driftjax.logs.extras import import_extra
from driftjax.sweep.analysis import analyse
from driftjax.sweep.config import Choices, DesignPoint, SweepConfig
from driftjax.sweep.source import Source
from driftjax.sweep.store import Store
from driftjax.sweep.trial import Outcome, Trial, Watch, Work, make_trial, objective

NAME = "sweep"  # of the study


class OptunaSource(Source):
    """Trials of a study in a database, which can be resumed."""

    adaptive = True

    def __init__(self, config: SweepConfig, work: Work, store: Store):
        self._optuna = import_extra("key 'design'", "optuna", "optuna", "optuna")
        self._optuna.logging.set_verbosity(self._optuna.logging.WARNING)
        self.config, self.work = config, work
        known, analysis = store.known_trials()[0], analyse(store, config)
        objectives = dict(zip(analysis.ids, map(float, analysis.objective), strict=True))
        self._values = {name: objectives.get(name, math.nan) for name in known}  # objective by id of the trial
        self._url = config.storage or f"sqlite:///{(store.path / 'optuna.db').resolve()}"
        self._study = self._open_study()
        self._running: dict[str, Any] = {}  # trials of the study by id of ours
        self.total, self.num_known = config.num, self._finished()

    def _open_study(self) -> Any:
        """Create the study, or load it from its database."""
        optuna, config = self._optuna, self.config
        sampler, pruner = (_named(getattr(optuna, kind), kind, getattr(config, kind[:-1])) for kind in KINDS)
        seeded = {"seed": config.seed} if config.sampler in SEEDED else {}
        try:
            return optuna.create_study(
                storage=self._url, sampler=sampler(**seeded), pruner=pruner(), study_name=NAME, load_if_exists=True
            )
        except TypeError as error:
            raise BadInput(
                f"keys 'sampler' and 'pruner': {config.sampler}, {config.pruner}: {error}; use others."
            ) from None
        except Exception as error:  # of any database, by any driver
            words = " ".join(str(error).split())[:160]
            raise BadInput(f"key 'storage' is '{config.storage}': it cannot be opened ({words}).") from None

    def _finished(self) -> int:
        return sum(trial.state.is_finished() for trial in self._study.get_trials(deepcopy=False))

    @property
    def watcher(self) -> partial | None:
        """Return the callback that reports each step to the study, where a pruner may end the trial."""
        return None if self.config.pruner == "NopPruner" else partial(make_watch, self._url)

    def trials(self) -> Iterator[Trial]:
        """Yield the trials that were running when the sweep stopped, then new ones."""
        states = self._optuna.trial.TrialState
        stopped = [frozen for frozen in self._study.get_trials(deepcopy=False) if frozen.state == states.RUNNING]
        for frozen in stopped:
            yield from self._of(_trial(self._study, self._url, frozen.number), dict(frozen.params))
        while self._finished() + len(self._running) < self.total:
            suggested = self._study.ask()
            yield from self._of(suggested, self._point(suggested))

    def _of(self, suggested: Any, point: DesignPoint) -> Iterator[Trial]:
        """Yield the trial, unless one with the same values has a result already."""
        if set(point) != set(self.config.varied):
            point = self._point(suggested)  # stopped while its values were drawn
        trial = make_trial(self.work, self.config, suggested.number, point)
        if trial.id in self._values or trial.id in self._running:
            self._tell_study(suggested, self._values.get(trial.id, math.nan))
            return
        self._running[trial.id] = suggested
        yield trial

    def _point(self, suggested: Any) -> DesignPoint:
        point: DesignPoint = {}
        for name, values in self.config.varied.items():
            if isinstance(values, Choices):
                point[name] = suggested.suggest_categorical(name, values.values)
            elif values.integer:
                point[name] = suggested.suggest_int(name, int(values.low), int(values.high), log=values.log)
            else:
                point[name] = suggested.suggest_float(name, values.low, values.high, log=values.log)
        return point

    def record(self, outcome: Outcome) -> None:
        """Report the objective to the study; a trial without one counts as failed."""
        suggested = self._running.pop(outcome.trial.id)
        value = objective(outcome.rows, self.config.objective, self.config.stage)
        self._values[outcome.trial.id] = value if outcome.status == "done" else math.nan
        if outcome.status == "pruned":
            self._study.tell(suggested, state=self._optuna.trial.TrialState.PRUNED)
        else:
            self._tell_study(suggested, self._values[outcome.trial.id])

    def _tell_study(self, suggested: Any, value: float) -> None:
        if math.isfinite(value):
            self._study.tell(suggested, value)
        else:
            self._study.tell(suggested, state=self._optuna.trial.TrialState.FAIL)


KINDS = ("samplers", "pruners")
SEEDED = ("TPESampler", "RandomSampler", "CmaEsSampler", "NSGAIISampler", "NSGAIIISampler", "QMCSampler", "GPSampler",
          "BruteForceSampler")  # fmt: skip


def _named(module: Any, kind: str, name: str) -> Any:
    known = [known_name for known_name in module.__all__ if known_name.endswith(kind[:-1].capitalize())]
    if name not in known:
        raise BadInput(f"key '{kind[:-1]}' is '{name}'; choose one of {', '.join(known)}.")
    return getattr(module, name)


def _trial(study: Any, url: str, number: int) -> Any:
    """Return trial `number` of the study with methods that write to its database."""
    import optuna

    storage = optuna.storages.get_storage(url)
    study_id = storage.get_study_id_from_name(NAME)
    return optuna.trial.Trial(study, storage.get_trial_id_from_study_id_trial_number(study_id, number))


def make_watch(url: str, trial: Trial, config: SweepConfig) -> Watch:
    """Make the callback that reports each step and asks whether to prune, in the process that runs `trial`."""
    import optuna

    study = optuna.load_study(study_name=NAME, storage=url, pruner=_named(optuna.pruners, "pruners", config.pruner)())
    suggested = _trial(study, url, trial.number)

    def watch(step: int, value: float) -> bool:
        if not math.isfinite(value):
            return False
        suggested.report(value, step)
        return suggested.should_prune()

    return watch
