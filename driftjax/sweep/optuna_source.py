"""Trials that Optuna chooses as results come in (Akiba et al. 2019)."""

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

from driftjax.core import BadInput
from driftjax.logs.extras import import_extra
from driftjax.sweep.analysis import see
from driftjax.sweep.config import Choices, SweepConfig
from driftjax.sweep.design import Point
from driftjax.sweep.store import Store
from driftjax.sweep.trial import Outcome, Trial, Watch, Work, objective, trial_of

NAME = "sweep"  # of the study


class Chosen:
    """Trials asked from a study, which lives in a database and goes on where it stopped."""

    adaptive = True

    def __init__(self, config: SweepConfig, work: Work, store: Store):
        self._optuna = import_extra("key 'design'", "optuna", "optuna", "optuna")
        self._optuna.logging.set_verbosity(self._optuna.logging.WARNING)
        self.config, self.work = config, work
        kept, seen = store.known()[0], see(store, config)
        objectives = dict(zip(seen.ids, map(float, seen.objective), strict=True))
        self._values = {name: objectives.get(name, math.nan) for name in kept}  # objective by id of the trial
        self._url = config.storage or f"sqlite:///{(store.path / 'optuna.db').resolve()}"
        self._study = self._begun()
        self._asked: dict[str, Any] = {}  # trials of the study by id of ours
        self.total, self.kept = config.num, self._finished()

    def _begun(self) -> Any:
        """The study in its database, made where there is none."""
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
    def watches(self) -> partial | None:
        """Reports each step of a trial to the study, where a pruner may end it."""
        return None if self.config.pruner == "NopPruner" else partial(watched, self._url)

    def trials(self) -> Iterator[Trial]:
        """Those asked for but not finished when the sweep stopped, then new ones."""
        states = self._optuna.trial.TrialState
        stopped = [frozen for frozen in self._study.get_trials(deepcopy=False) if frozen.state == states.RUNNING]
        for frozen in stopped:
            yield from self._of(_trial(self._study, self._url, frozen.number), dict(frozen.params))
        while self._finished() + len(self._asked) < self.total:
            asked = self._study.ask()
            yield from self._of(asked, self._point(asked))

    def _of(self, asked: Any, point: Point) -> Iterator[Trial]:
        """The trial; the values of one that was run before, or kept just when the sweep stopped, are not run again."""
        if set(point) != set(self.config.varied):
            point = self._point(asked)  # stopped while its values were drawn
        trial = trial_of(self.work, self.config, asked.number, point)
        if trial.id in self._values or trial.id in self._asked:
            self._told(asked, self._values.get(trial.id, math.nan))
            return
        self._asked[trial.id] = asked
        yield trial

    def _point(self, asked: Any) -> Point:
        point: Point = {}
        for name, values in self.config.varied.items():
            if isinstance(values, Choices):
                point[name] = asked.suggest_categorical(name, values.values)
            elif values.integer:
                point[name] = asked.suggest_int(name, int(values.low), int(values.high), log=values.log)
            else:
                point[name] = asked.suggest_float(name, values.low, values.high, log=values.log)
        return point

    def tell(self, outcome: Outcome) -> None:
        """The objective into the study; a trial without one has failed there."""
        asked = self._asked.pop(outcome.trial.id)
        value = objective(outcome.rows, self.config.objective, self.config.stage)
        self._values[outcome.trial.id] = value if outcome.status == "done" else math.nan
        if outcome.status == "pruned":
            self._study.tell(asked, state=self._optuna.trial.TrialState.PRUNED)
        else:
            self._told(asked, self._values[outcome.trial.id])

    def _told(self, asked: Any, value: float) -> None:
        if math.isfinite(value):
            self._study.tell(asked, value)
        else:
            self._study.tell(asked, state=self._optuna.trial.TrialState.FAIL)


KINDS = ("samplers", "pruners")
SEEDED = ("TPESampler", "RandomSampler", "CmaEsSampler", "NSGAIISampler", "NSGAIIISampler", "QMCSampler", "GPSampler",
          "BruteForceSampler")  # fmt: skip


def _named(module: Any, kind: str, name: str) -> Any:
    known = [found for found in module.__all__ if found.endswith(kind[:-1].capitalize())]
    if name not in known:
        raise BadInput(f"key '{kind[:-1]}' is '{name}'; choose one of {', '.join(known)}.")
    return getattr(module, name)


def _trial(study: Any, url: str, number: int) -> Any:
    """Return trial `number` of the study with methods that write to its database."""
    import optuna

    storage = optuna.storages.get_storage(url)
    study_id = storage.get_study_id_from_name(NAME)
    return optuna.trial.Trial(study, storage.get_trial_id_from_study_id_trial_number(study_id, number))


def watched(url: str, trial: Trial, config: SweepConfig) -> Watch:
    """In the process that runs `trial`: tells the study of each step, and asks it whether to go on."""
    import optuna

    study = optuna.load_study(study_name=NAME, storage=url, pruner=_named(optuna.pruners, "pruners", config.pruner)())
    asked = _trial(study, url, trial.number)

    def watch(step: int, value: float) -> bool:
        if not math.isfinite(value):
            return False
        asked.report(value, step)
        return asked.should_prune()

    return watch
