"""Fit chosen effects of the nominal car to data, without testing whether they are present."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from driftjax.core import BadInput, require
from driftjax.diagnosis.calibration_fit import CalibrationFit, fit_by_predictions, fit_by_steps, fit_by_the_better
from driftjax.diagnosis.comparison import Comparison
from driftjax.diagnosis.evidence import half_widths
from driftjax.diagnosis.fit import GYRO, Problem, at_bound, information, initial_problem, time_lost, with_noise
from driftjax.diagnosis.gain import DECISIVE, horizon_steps, predict
from driftjax.diagnosis.held_out import PredictionGain, check_held_out, compare_models, split_runs
from driftjax.diagnosis.identifiability import Identifiability, identifiability
from driftjax.diagnosis.multistart import with_nominal_noise
from driftjax.diagnosis.noise_floor import noise_floor
from driftjax.diagnosis.resolve import resolved_log
from driftjax.diagnosis.score import Scores, scores, spread_of
from driftjax.diagnosis.serialise import extended_car, gain_json
from driftjax.diagnosis.stages import STAGES, least_samples
from driftjax.diagnosis.stretches import Stretch, durations
from driftjax.environment import require_float64
from driftjax.logs import Log
from driftjax.store import RunFolder
from driftjax.store.files import write_json
from driftjax.vehicle import VehicleConfig, write_vehicle
from driftjax.vehicle.effect import EFFECTS, Effect, default_catalogue, effects_by_name

DEFAULT_EFFECTS = ("friction", "stiffness_front", "stiffness_rear", "drive_gain", "steer_offset")
STAGED_EFFECTS = (
    "drive_gain", "drive_lag", "rolling_resistance", "aero_drag", "steer_offset", "steer_gain", "steer_lag",
    "stiffness_front", "stiffness_rear", "friction", "tyre_shape", "combined_slip",
)  # fmt: skip
MENTIONED = 0.1  # share in an estimate from which a stretch is mentioned in the table
DISAGREES = 2.0  # standard deviations by which later stretches move an estimate, from which they are said to disagree


class FittedParameter(NamedTuple):
    """One fitted parameter, SI."""

    parameter: str  # effect.parameter
    value: float
    ci95_half: float  # half-width of its 95 % interval
    unit: str
    at_bound: bool  # these data ask for more
    decided_by: dict[str, float]  # kind of stretch, and prior: its share in the estimate
    dead: bool  # these data say nothing of it
    flat: bool  # its interval is wider than its typical size
    trades_off_with: tuple[str, ...]  # parameters that these data hardly tell it apart from
    moved: float  # by later stages, in standard deviations of the estimate of its own stage; 0 of a fit at once

    @property
    def remarks(self) -> str:
        """Return the remarks on its identifiability for the table."""
        if self.dead:
            return "dead: these data say nothing of it"
        remarks = ["at its bound: these data ask for more"] if self.at_bound else []
        remarks += ["flat: the interval is wider than the typical size"] if self.flat else []
        remarks += [f"trades off with {', '.join(self.trades_off_with)}"] if self.trades_off_with else []
        if abs(self.moved) > DISAGREES:
            remarks.append(f"harder stretches disagree: they moved it by {self.moved:+.1f} standard deviations")
        return "; ".join(remarks)


@dataclass(frozen=True)
class Calibration:
    """Car fitted to data, with its gain on held-out runs; `str` gives its table."""

    nominal: VehicleConfig
    log: Log
    selected: tuple[int, ...]  # effects that were fitted, numbers in the catalogue
    car: CalibrationFit
    scores: Scores  # with the precision of the parameters for information
    half_width: np.ndarray  # (k,) of the 95 % intervals, in typical sizes
    identifiability: tuple[Identifiability, ...]  # of each parameter
    staged: bool
    held_out: int  # every so many-th run was
    gain: PredictionGain | None  # on runs held out, of a car fitted without them; None where there are too few
    lost_s: float  # of the runs, in which the observer loses the car [s]
    missing: dict[str, str]  # default effects that are not fitted, with the columns that a run lacks for them

    @property
    def problem(self) -> Problem:
        """Return the problem with noise and observer of the fitted car."""
        return self.car.problem

    @property
    def vehicle(self) -> VehicleConfig:
        """Return the calibrated car, for simulator, planner, equilibria, MPC and `diagnose`; without dead effects."""
        alive = dict(zip(self.problem.columns(self.selected), self.identifiability, strict=True))
        identified = tuple(i for i in self.selected if not all(alive[k].dead for k in self.problem.columns((i,))))
        spread = spread_of(self.scores.H, self.scores.blocks, self.problem.columns(identified))
        return extended_car(self.nominal, self.problem, identified, self.car.fit.theta, spread)

    @property
    def parameters(self) -> tuple[FittedParameter, ...]:
        """Return every fitted parameter, SI."""
        problem = self.problem
        columns, scale = problem.columns(self.selected), np.asarray(problem.model.scale)
        parameters = [(problem.effects[i], p) for i in self.selected for p in problem.effects[i].parameters]
        names, bound = [f"{effect.name}.{p.name}" for effect, p in parameters], at_bound(problem, self.car.fit.theta)
        return tuple(
            FittedParameter(
                name, float(self.car.fit.theta[k] * scale[k]), float(half * scale[k]), p.unit, bool(bound[k]),
                dict(zip([kind.label for kind in Stretch] + ["prior"], map(float, one.shares), strict=True)),
                one.dead, one.flat,
                tuple(names[i] for i in one.trades_off_with), float(moved),
            )
            for name, (_, p), k, half, one, moved in zip(
                names, parameters, columns, self.half_width, self.identifiability, self.car.moved[columns], strict=True
            )
        )  # fmt: skip

    @property
    def lacking(self) -> tuple[str, ...]:
        """Return sentences on kinds of stretch of less than 10 sqrt(L/g), on lost time, and on what the fit follows."""
        least, names = least_samples(self.problem), []
        missing = [kind for kind in Stretch if np.sum(self.car.stretch == kind) < least]
        for kind in missing:
            stage = next(stage for stage in STAGES if kind in stage.stretches)
            own = [self.problem.effects[i].name for i in self.selected if self.problem.effects[i].name in stage.effects]
            names.append(f"no {kind.label} stretch: {', '.join(own)} must be decided by others" if own else "")
        if self.missing:
            without = ", ".join(f"{effect} (needs {needs})" for effect, needs in self.missing.items())
            names.append(f"not fitted, since a run lacks a column: {without}")
        if self.lost_s:
            names.append(f"{self.lost_s:.1f} s do not count, in which the observer loses the car: start from a car "
                         "nearer to the real one, such as with the delay that `inspect` prints")  # fmt: skip
        if self.car.by_predictions:
            memory = horizon_steps(self.problem)[DECISIVE] * self.problem.data.dt
            names.append(f"single steps mislead here: the parameters are those that an observer with a memory of "
                         f"{memory:.2g} s gives")  # fmt: skip
        return tuple(f"{sentence}." for sentence in names if sentence)

    def content(self) -> dict[str, Any]:
        """Return the content of calibration.json."""
        noise = self.problem.noise
        return {
            "parameters": [one._asdict() for one in self.parameters],
            "staged": self.staged,
            "fitted_by": "predictions" if self.car.by_predictions else "single steps",
            "stretches_s": durations(self.car.stretch, self.problem.data.dt),
            "lacking": list(self.lacking),
            "lost_s": self.lost_s,
            "gain": gain_json(self.gain),
            "noise": {
                "measurement": noise.sigma.tolist(), "process": noise.disturbance.tolist(),
                "correlation_s": float(noise.correlation), "slow": noise.slow.tolist(),
                "slow_correlation_s": float(noise.slow_correlation),
            },
        }  # fmt: skip

    def save(self, folder: str | Path) -> Path:
        """Write calibrated.yaml and calibration.json into `folder`, a run folder of `driftjax calibrate`."""
        names = [self.problem.effects[i].name for i in self.selected]
        settings = calibrate_settings(self.nominal, self.log, names, self.staged, self.held_out)
        folder = RunFolder.ensure(folder, settings, "calibrate").path
        write_vehicle(folder / "calibrated.yaml", self.vehicle)
        write_json(folder / "calibration.json", self.content())
        return folder

    def __str__(self) -> str:
        times = durations(self.car.stretch, self.problem.data.dt).items()
        lines = [f"stretches: {', '.join(f'{name} {time:.1f} s' for name, time in times)}", *self.lacking]
        lines.append(f"{'parameter':28}{'value':>12}{'':3}{'95 %':>9}{'':11}{'decided by':40}remarks")
        for one in self.parameters:
            unit = "" if one.unit == "1" else one.unit
            shares = sorted(one.decided_by.items(), key=lambda pair: -pair[1])
            by = ", ".join(f"{name} {share:.0%}" for name, share in shares if share >= MENTIONED)
            number = f"{one.value:12.4g} ± {one.ci95_half:9.2g} {unit:10}"
            lines.append(f"{one.parameter:28}{number}{by or 'nothing':40}{one.remarks}".rstrip())
        return "\n".join(lines) + "\n"


def calibrate_settings(
    vehicle: VehicleConfig, log: Log, effects: Sequence[str], staged: bool, held_out: int
) -> dict[str, Any]:
    """Return the content of config.yaml of a calibration."""
    own = {"staged": staged, "effects": list(effects), "held_out": held_out}
    return {"vehicle": asdict(vehicle)} | log.reading | own


def calibrate(
    vehicle: VehicleConfig, log: Log, effects: Sequence[str] | None = None, *, staged: bool = False, held_out: int = 3,
    seed: int = 0, catalogue: tuple[Effect, ...] | None = None, report: Callable[[str], None] = lambda text: None,
) -> Calibration:  # fmt: skip
    """Fit the `effects` of the car to a log; all others stay as in `vehicle`.

    Nothing is tested here: what `diagnose` should find later is to be left out. `staged`: gentle stretches of the log
    decide first, see `stages`. Without `effects` they are those of `effects_to_fit` that the runs
    determine. Every `held_out`-th run is held out to measure the gain on, by a fit of its own; 0: none is. `report` is
    called at every step. Values are in SI. Raises `BadInput` for `effects` that these runs do not determine.
    """
    require_float64()
    check_held_out(held_out)
    log, wanted = resolved_log(vehicle, log), effects_to_fit(effects, staged)
    if catalogue is None:
        catalogue = default_catalogue(*wanted, *(one.effect for one in vehicle.effects))
    problem = initial_problem(vehicle, catalogue, log.runs)
    selected, missing = select_effects(problem, wanted)
    if missing and (effects is not None or not selected):
        effect, needs = next(iter(missing.items()))
        raise BadInput(f"effect '{effect}' needs the column {needs}, which a run lacks; add it or leave the effect.")
    report("noise and nominal car: compile roll-outs")
    loose, columns = with_nominal_noise(problem), problem.columns(selected)
    report("gain: fit without the runs held out, compile derivatives")
    names, words = tuple(run.name for run in log.runs), lambda text: report(f"fit: {text}")
    gain = calibration_gain(problem, selected, names, held_out, seed, staged)
    report("fit: to all runs")
    if gain is None:
        car = fit_by_the_better(loose, selected, staged, seed, words)
    else:  # what predicts better without the runs held out does so with them
        steps = fit_by_steps(loose, selected, staged, words)
        car = (fit_by_predictions(steps, selected, staged, words) if gain.by_predictions else None) or steps
    report("what decides each parameter")
    searched, linearisation = car.searched, car.linearisation
    lost_s = time_lost(searched, linearisation)
    last = scores(searched, linearisation, car.fit.theta, selected, seed)._replace(H=car.precision)
    half_width, square = half_widths(searched, last, selected), np.ix_(columns, columns)
    J = np.asarray(linearisation.J)
    known = np.stack([information(J[car.stretch == kind][None])[square] for kind in Stretch])
    identifiable = identifiability(known, car.prior[columns], car.precision[square], half_width)
    return Calibration(
        vehicle, log, selected, car, last, half_width, identifiable, staged, held_out, gain, lost_s, missing
    )  # fmt: skip


def effects_to_fit(effects: Sequence[str] | None = None, staged: bool = False) -> tuple[str, ...]:
    """Return the names of the `effects` that `calibrate` fits, in the catalogue's order; where None, the default ones.

    `staged`: those of a calibration by stages, which decides more. Raises `BadInput` for none and for unknown names.
    """
    names = tuple((STAGED_EFFECTS if staged else DEFAULT_EFFECTS) if effects is None else effects)
    require(bool(names), "key 'effects' is empty; name the effects to fit.")
    return tuple(effect.name for effect in effects_by_name(names))


def select_effects(problem: Problem, wanted: Sequence[str]) -> tuple[tuple[int, ...], dict[str, str]]:
    """Return the numbers of the `wanted` effects that the runs determine, and what columns the others need."""
    numbers = [i for i, effect in enumerate(problem.effects) if effect.name in wanted]
    selected = tuple(i for i in numbers if problem.active[problem.columns((i,))].all())
    others = (problem.effects[i].name for i in numbers if i not in selected)
    sensor = lambda name: ("r",) if name in GYRO else ("Fxr",)
    return selected, {name: " and ".join(EFFECTS[name].needs or sensor(name)) for name in others}


def calibration_gain(
    problem: Problem, selected: tuple[int, ...], names: tuple[str, ...], held_out: int, seed: int, staged: bool
) -> PredictionGain | None:
    """Return the gain on every `held_out`-th run of the effects `selected`, fitted without those runs.

    Noise and observer are those of the other runs too.
    """
    use, held = split_runs(len(names), held_out)
    if not len(held):
        return None
    loose, apart = with_nominal_noise(problem.subset(use)), problem.subset(held)
    car = fit_by_the_better(loose, selected, staged, seed)
    theta = car.fit.theta
    bare, test = with_noise(apart, problem.start, loose.noise), with_noise(apart, theta, car.problem.noise)
    ahead = {"nominal": predict(bare, bare.start), "fitted": predict(test, theta)}
    comparison = Comparison(test, ahead, noise_floor(test, theta, ahead["fitted"], seed))
    gain = compare_models(comparison, tuple(names[i] for i in held), selected, seed)
    return replace(gain, by_predictions=car.by_predictions)
