"""Diagnose a log: name the causes with their uncertainty, and measure the gain of correcting them."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from driftjax.core import BadInput
from driftjax.diagnosis.comparison import Comparison, compare_on_own_runs, comparison_shares
from driftjax.diagnosis.evidence import Cause, NamedEffect, find_causes, named_effects, spread_with, with_sizes
from driftjax.diagnosis.figure_data import figure_data
from driftjax.diagnosis.findings import Findings, describe_errors
from driftjax.diagnosis.fit import Problem, initial_problem, with_estimated_noise
from driftjax.diagnosis.gain import DECISIVE, Share, horizon_steps
from driftjax.diagnosis.held_out import (
    DiagnoseConfig,
    PredictionGain,
    fit_sizes,
    measure_gain,
    refit_extended,
    refit_retuned,
    retuned_effects,
    split_runs,
)
from driftjax.diagnosis.log_limits import Unidentifiable, find_unidentifiable
from driftjax.diagnosis.naming import leave_out_unconfirmed
from driftjax.diagnosis.outliers import count_outliers
from driftjax.diagnosis.prediction_fit import PredictionFit
from driftjax.diagnosis.predictive_naming import Naming, name_by_predictions, name_by_steps, name_by_the_better
from driftjax.diagnosis.propose import Proposal, propose_manoeuvre
from driftjax.diagnosis.resolve import resolved_log
from driftjax.diagnosis.select import Selection
from driftjax.diagnosis.serialise import diagnosis_json, estimated_noise, extended_car
from driftjax.diagnosis.unexplained_errors import Unexplained, find_unexplained
from driftjax.diagnosis.verdict import (
    MIN_DURATION,
    Explained,
    Judgement,
    Verdict,
    decide_verdict,
    describe_answer,
    describe_fit,
    explained_by,
    without_lost_time,
)
from driftjax.diagnosis.warm_up import compile_programs
from driftjax.environment import require_float64
from driftjax.logs import Log, read_log
from driftjax.manoeuvres.truth import drive_again
from driftjax.parallel import process_executor, spare_workers
from driftjax.store import RunFolder
from driftjax.store.files import write_json, write_netcdf
from driftjax.vehicle import VehicleConfig, write_vehicle
from driftjax.vehicle.effect import Effect, default_catalogue


@dataclass(frozen=True)
class Evidence:
    """Evidence for a verdict."""

    naming: Naming
    causes: list[Cause]
    unexplained: Unexplained
    proposal: Proposal | None
    gain: PredictionGain | None  # None where there are too few runs to hold any out
    comparison: Comparison  # of the models on the runs held out, or on all
    explained: Explained | None  # None where no run is long enough
    answer: str  # car that predicts best on held-out runs: nominal, retuned or extended
    retuned: PredictionFit | None  # the re-tuned car on all runs, where that is the answer
    sizes: PredictionFit | None  # of the named effects on all runs, where the likelihood leaves an excess error
    unidentifiable: Unidentifiable  # what the log leaves unidentifiable, since channels are missing
    unconfirmed: tuple[str, ...]  # effects named from all runs, left out again: neither size nor other runs show them

    @property
    def problem(self) -> Problem:
        """Return the problem from the states of whose observer predictions start."""
        return self.naming.problem

    @property
    def selection(self) -> Selection:
        """Return the named effects, fitted."""
        return self.naming.selection


@dataclass(frozen=True)
class Diagnosis:
    """Result of a diagnosis: errors of the model of a car, their causes, and the gain of correcting them."""

    vehicle: VehicleConfig
    """The nominal car."""
    log: Log
    config: DiagnoseConfig
    judgement: Judgement
    evidence: Evidence | None
    """None where the log is too short: the verdict is DATA_INSUFFICIENT."""

    @property
    def verdict(self) -> Verdict:
        """Return the verdict: NOTHING, NAMED, SET, UNKNOWN or DATA_INSUFFICIENT."""
        return self.judgement.verdict

    @property
    def sentence(self) -> str:
        """Return the verdict in words, with units."""
        return self.judgement.sentence

    @property
    def causes(self) -> tuple[NamedEffect, ...]:
        """Return every named effect with its probability, parameters (SI) and rivals."""
        return named_effects(self.evidence.problem, self.evidence.causes) if self.evidence else ()

    @property
    def gain(self) -> PredictionGain | None:
        """Return the prediction errors on held-out runs, of effects named and fitted without them; None without any."""
        return self.evidence.gain if self.evidence else None

    @property
    def proposal(self) -> Proposal | None:
        """Return the manoeuvre to drive next, which best separates rival explanations."""
        return self.evidence.proposal if self.evidence else None

    @property
    def extended(self) -> VehicleConfig:
        """Return the car to use from now on, in simulator, planner, equilibria and MPC: the one with the named effects.

        Where that predicts held-out runs worse than the nominal car or the re-tuned one (friction and stiffness), it
        is the better one of these.
        """
        if self.evidence is None:
            return self.vehicle
        last, problem, sizes = self.evidence.selection, self.evidence.problem, self.evidence.sizes
        if self.evidence.answer == "nominal":
            return replace(self.vehicle, noise=estimated_noise(problem))
        if retuned := self.evidence.retuned:
            return extended_car(self.vehicle, problem, retuned_effects(problem), retuned.theta, retuned.spread)
        theta = sizes.theta if sizes else last.fit.theta
        return extended_car(self.vehicle, problem, last.selected, theta, spread_with(problem, last, sizes))

    def drive_proposal(self, truth: Path, path: Path, *, cut: float | None = None) -> Log:
        """Drive the proposed manoeuvre on the simulated car that the file `truth` describes, and write it to `path`.

        Returns the log of the diagnosis read again, with that run, as `read_log` does. Raises `BadInput` where nothing
        is proposed, or where the log came from no file.
        """
        if self.proposal is None:
            raise BadInput("This diagnosis proposes no manoeuvre; there is nothing to drive.")
        if not self.log.paths:
            raise BadInput("The log of this diagnosis came from no file; write it with write_log, and read that.")
        drive_again(truth, self.proposal.manoeuvre, path)
        return read_log((*self.log.paths, path), cut=cut)

    def describe_errors(self) -> Findings | None:
        """Compute residual forces, kinematic parity, open-loop errors and all else that figures draw."""
        if self.evidence is None:
            return None
        evidence, runs = self.evidence, self.log.runs
        refitted = evidence.sizes.theta if evidence.sizes else None
        if evidence.naming.by_predictions and refitted is None:  # the path of another observer
            refitted = evidence.selection.fit.theta
        return describe_errors(
            self.vehicle, evidence.problem, runs, evidence.selection, evidence.comparison, self.config.seed, refitted
        )

    def content(self, findings: Findings | None = None) -> dict[str, Any]:
        """Return the content of diagnosis.json, schema version 1, with the block `show` where `findings` are given."""
        return diagnosis_json(self, findings)

    def save(self, folder: str | Path) -> Path:
        """Write diagnosis.json and, of a log that was long enough, extended.yaml and diagnosis.nc into `folder`.

        It becomes a run folder of `driftjax diagnose` if it is none yet: `write_diagnosis(folder)` adds the report.
        """
        folder = RunFolder.ensure(folder, diagnose_settings(self.vehicle, self.log, self.config), "diagnose").path
        findings = self.describe_errors()
        if self.evidence is not None and findings is not None:
            write_vehicle(folder / "extended.yaml", self.extended)
            data = figure_data(self.vehicle.name, self.evidence.problem, self.evidence.selection, findings, self.gain)
            write_netcdf(folder / "diagnosis.nc", data)
        write_json(folder / "diagnosis.json", self.content(findings))
        return folder


def diagnose_settings(vehicle: VehicleConfig, log: Log, config: DiagnoseConfig) -> dict[str, Any]:
    """Return the content of config.yaml of a diagnosis."""
    return {"vehicle": asdict(vehicle)} | log.reading | {"options": asdict(config)}


def diagnose(
    vehicle: VehicleConfig,
    log: Log,
    config: DiagnoseConfig | None = None,
    *,
    workers: int | None = 0,
    report: Callable[[str], None] = lambda text: None,
    effects: tuple[Effect, ...] | None = None,
) -> Diagnosis:
    """Diagnose the errors of the model of `vehicle` from `log`, measured in SI and radians, left positive.

    Causes are named from all runs. The gain is that of what is named and fitted without the runs held out, which have
    no part in the noise and the observer either. `effects` is the catalogue to choose from: all but those on
    request, and those of `config.beside`, if omitted. Another one is another model to compile. The gain is measured
    meanwhile: with `workers` = 1 in a process of its own, which halves the time where two cores are free (a script then
    needs `if __name__ == "__main__"`), with 0 in a thread, with None as suits the machine. `report` is called at every
    step. Raises `BadInput` for runs whose sample times differ.
    """
    require_float64()
    workers = spare_workers() if workers is None else workers
    config = DiagnoseConfig() if config is None else config
    log = resolved_log(vehicle, log)
    duration = sum(len(run.t) * run.dt for run in log.runs)
    if duration < MIN_DURATION:
        text = f"The log holds {duration:.1f} s; at least {MIN_DURATION:.0f} s are needed to tell anything."
        return Diagnosis(vehicle, log, config, Judgement(Verdict.DATA_INSUFFICIENT, text), None)
    if any(lost := count_outliers(log.runs, vehicle.a + vehicle.b).values()):
        report(f"noise and nominal car: {sum(lost)} outliers left out")
    report("noise and nominal car: compile roll-outs and derivatives")
    if effects is None:
        effects = default_catalogue(*config.beside, *(one.effect for one in vehicle.effects))
    initial = initial_problem(vehicle, effects, log.runs, config.without)
    names = tuple(run.name for run in log.runs)
    with process_executor(workers) as processes, ThreadPoolExecutor(2) as threads:
        measure = processes.submit(measure_gain, initial, names, config)
        measured = threads.submit(measure)  # without a worker the thread computes, else it waits
        compiled = threads.submit(compile_programs, initial)
        held_out = len(split_runs(len(names), config.held_out)[1]) > 0
        named = _name_causes(initial, config, held_out, report)
        report("gain")
        gain = measured.result()
        compiled.result()  # raises what went wrong there
    return _conclude(vehicle, log, config, duration, _judged_by_gain(named, gain, config, report), gain)


class _Compared(NamedTuple):
    """Cars compared by their predictions."""

    sizes: PredictionFit | None  # fitted to predictions, where the likelihood does not suffice
    comparison: Comparison
    shares: dict[str, Share]  # of the excess error that each car removes


class _Named(NamedTuple):
    """Effects named from all runs, with their evidence."""

    naming: Naming
    causes: list[Cause]
    unexplained: Unexplained
    unconfirmed: tuple[str, ...] = ()
    compared: _Compared | None = None  # on own runs, where known


def _name_causes(initial: Problem, config: DiagnoseConfig, held_out: bool, report: Callable[[str], None]) -> _Named:
    """Name the causes from all runs of the problem, its noise estimated from all of them too.

    Where runs are `held_out`, the gain on them decides whether single steps name the effects; otherwise own runs do.
    """
    problem = with_estimated_noise(initial, initial.start, initial.active)
    report("naming")
    if held_out:
        return _with_evidence(name_by_steps(problem, config.seed, config.most, report), config)
    naming, _ = name_by_the_better(problem, config.seed, config.most, config.unexplained, report)
    return _with_evidence(naming, config)


def _with_evidence(naming: Naming, config: DiagnoseConfig, unconfirmed: tuple[str, ...] = ()) -> _Named:
    problem, found = naming.searched, naming.found
    return _Named(naming, find_causes(problem, found), find_unexplained(problem, found, config.seed), unconfirmed)


def _judged_by_gain(
    named: _Named, gain: PredictionGain | None, config: DiagnoseConfig, report: Callable[[str], None]
) -> _Named:
    """Name by predictions where that was better without the held-out runs, leave out what nothing confirms."""
    if gain is None:
        return _judged_by_own_runs(named, config)
    if "extended" not in gain.skills:
        return named
    naming = name_by_predictions(named.naming, config.seed, config.most, report) if gain.by_predictions else None
    naming, share = naming or named.naming, gain.skills["extended"].value
    found, unconfirmed = leave_out_unconfirmed(naming.searched, naming.found, share, gain.named, config.seed)
    if naming is named.naming and not unconfirmed:
        return named
    return _with_evidence(naming.with_found(found), config, unconfirmed)


def _judged_by_own_runs(named: _Named, config: DiagnoseConfig) -> _Named:
    """Leave out what predictions of the own runs do not confirm, where the drive force was inferred."""
    naming = named.naming
    if not (naming.problem.data.force_inferred and named.causes):
        return named
    compared = _compare_cars(naming, None, config)
    if "extended" not in compared.shares:
        return named._replace(compared=compared)
    share = compared.shares["extended"].value
    found, unconfirmed = leave_out_unconfirmed(naming.searched, naming.found, share, (), config.seed)
    if not unconfirmed:
        return named._replace(compared=compared)
    return _with_evidence(naming.with_found(found), config, unconfirmed)


def _compare_cars(naming: Naming, gain: PredictionGain | None, config: DiagnoseConfig) -> _Compared:
    """Compare the cars by their predictions: those of the `gain` on runs held out, else those on all runs."""
    problem, selection = naming.problem, naming.selection
    if gain:  # what holds without the runs held out holds with them
        sizes = refit_extended(problem, selection) if gain.refitted and selection.selected else None
        return _Compared(sizes, gain.comparison, gain.skills)
    compare = partial(compare_on_own_runs, selection.base, selection.nominal.theta, problem, seed=config.seed)
    likely, sizes = selection.fit.theta, None
    if selection.selected:
        sizes = fit_sizes(problem, selection, compare(likely, disturbed=False), config)
    comparison = compare(sizes.theta if sizes else likely)
    return _Compared(sizes, comparison, comparison_shares(comparison, config.seed))


def _conclude(
    vehicle: VehicleConfig,
    log: Log,
    config: DiagnoseConfig,
    duration: float,
    named: _Named,
    gain: PredictionGain | None,
) -> Diagnosis:
    """Return the diagnosis: the verdict by the size of the error left, the car to use, the next manoeuvre."""
    naming, causes, remaining, unconfirmed, compared = named
    problem, selection, searched, found = naming.problem, naming.selection, naming.searched, naming.found
    sizes, comparison, shares = compared or _compare_cars(naming, gain, config)
    causes = with_sizes(problem, causes, sizes) if sizes else causes
    horizon = float(horizon_steps(problem)[DECISIVE] * problem.data.dt)
    explained = explained_by(shares, bool(causes), horizon, gain is not None)
    judgement = decide_verdict(searched, found, causes, remaining, duration, explained, config.unexplained, unconfirmed)
    answer = gain.best if gain and selection.selected else "extended"
    retuned = refit_retuned(selection) if answer == "retuned" else None
    unidentifiable = find_unidentifiable(searched, found, {one.effect: tuple(one.rivals) for one in causes})
    judgement = without_lost_time(judgement, unidentifiable.lost_s, duration, config.unexplained)
    other = describe_answer(answer, problem, retuned, shares)
    words = f"{other}{judgement.sentence}", describe_fit(naming.by_predictions, sizes, horizon), unidentifiable.sentence
    judgement = judgement._replace(sentence=" ".join(one for one in words if one))
    proposal = propose_manoeuvre(vehicle, searched, found, causes, judgement, config.seed)
    evidence = Evidence(
        naming, causes, remaining, proposal, gain, comparison, explained, answer, retuned, sizes, unidentifiable,
        unconfirmed,
    )  # fmt: skip
    return Diagnosis(vehicle, log, config, judgement, evidence)
