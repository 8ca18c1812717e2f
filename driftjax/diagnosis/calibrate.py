"""Fit chosen effects of the nominal car to data, without testing whether they are present."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from driftjax.core import BadInput, require
from driftjax.diagnosis.evidence import half_widths
from driftjax.diagnosis.findings import Comparison
from driftjax.diagnosis.fit import (
    Fit,
    Problem,
    at_bound,
    evaluate,
    initial_problem,
    refit_to_convergence,
    with_estimated_noise,
    with_noise,
)
from driftjax.diagnosis.gain import predict
from driftjax.diagnosis.held_out import Gain, check_held_out, compare, split_runs
from driftjax.diagnosis.multistart import nominal_fit, require_finite, with_nominal_noise
from driftjax.diagnosis.noise_floor import noise_floor
from driftjax.diagnosis.runs import Linearisation
from driftjax.diagnosis.score import Scores, scores
from driftjax.diagnosis.serialise import extended_car, gain_json
from driftjax.environment import require_float64
from driftjax.logs import Log
from driftjax.store.files import write_json
from driftjax.vehicle import VehicleConfig, write_vehicle
from driftjax.vehicle.effect import EFFECTS, Effect, effects_by_name

DEFAULT_EFFECTS = ("friction", "stiffness_front", "stiffness_rear", "drive_gain", "steer_offset")


class FittedParameter(NamedTuple):
    """One fitted parameter, SI."""

    parameter: str  # effect.parameter
    value: float
    ci95_half: float  # half-width of its 95 % interval
    unit: str
    at_bound: bool  # these data ask for more


@dataclass(frozen=True)
class Calibration:
    """A car fitted to data, with its gain on held-out runs; `str` gives its table."""

    nominal: VehicleConfig
    problem: Problem  # with noise and observer of the fitted car
    selected: tuple[int, ...]  # effects that were fitted, numbers in the catalogue
    fit: Fit
    scores: Scores
    half_width: np.ndarray  # (k,) of the 95 % intervals, in typical sizes
    bound: tuple[str, ...]  # parameters that ended on a bound of theirs
    gain: Gain | None  # on runs held out, of a car fitted without them; None where there are too few

    @property
    def vehicle(self) -> VehicleConfig:
        """Return the calibrated car, for simulator, planner, equilibria, MPC and `diagnose`."""
        return extended_car(self.nominal, self.problem, self.selected, self.fit.theta, self.scores)

    @property
    def parameters(self) -> tuple[FittedParameter, ...]:
        """Return every fitted parameter, SI."""
        problem = self.problem
        columns, scale = problem.columns(self.selected), np.asarray(problem.model.scale)
        names = [(problem.effects[i].name, p) for i in self.selected for p in problem.effects[i].parameters]
        values, widths = self.fit.theta[columns] * scale[columns], self.half_width * scale[columns]
        return tuple(
            FittedParameter(f"{name}.{p.name}", float(value), float(half), p.unit, f"{name}.{p.name}" in self.bound)
            for (name, p), value, half in zip(names, values, widths, strict=True)
        )

    def content(self) -> dict[str, Any]:
        """Return the content of calibration.json."""
        noise = self.problem.noise
        return {
            "parameters": [one._asdict() for one in self.parameters],
            "gain": gain_json(self.gain),
            "noise": {"measurement": noise.sigma.tolist(), "process": noise.disturbance.tolist(),
                      "correlation_s": noise.correlation},
        }  # fmt: skip

    def save(self, folder: str | Path) -> Path:
        """Write calibrated.yaml and calibration.json into `folder`."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_vehicle(folder / "calibrated.yaml", self.vehicle)
        write_json(folder / "calibration.json", self.content())
        return folder

    def __str__(self) -> str:
        lines = [f"{'parameter':28}{'value':>12}{'':3}{'95 %':>9}"]
        for one in self.parameters:
            end = "   on its bound: these data ask for more" if one.at_bound else ""
            unit = "" if one.unit == "1" else one.unit
            lines.append(f"{one.parameter:28}{one.value:12.4g} ± {one.ci95_half:9.2g} {unit}{end}".rstrip())
        return "\n".join(lines) + "\n"


def calibrate(
    vehicle: VehicleConfig, log: Log, effects: Sequence[str] = DEFAULT_EFFECTS, *, held_out: int = 3, seed: int = 0,
    catalogue: tuple[Effect, ...] = tuple(EFFECTS.values()),
) -> Calibration:  # fmt: skip
    """Fit the `effects` of the car to a log; all others stay as in `vehicle`.

    Nothing is tested here: what `diagnose` should find later is to be left out. Every `held_out`-th run is held out
    to measure the gain on, by a fit of its own; 0: none is. Raises `BadInput` for effects that these runs cannot tell.
    """
    require_float64()
    check_held_out(held_out)
    require(bool(effects), "key 'effects' is empty; name the effects to fit.")
    runs, names = log.runs, tuple(effects)
    wanted = {effect.name for effect in effects_by_name(names)}
    problem = initial_problem(vehicle, catalogue, runs)
    selected = tuple(i for i, effect in enumerate(problem.effects) if effect.name in wanted)
    lost = [problem.effects[i].name for i in selected if not problem.active[problem.columns((i,))].all()]
    if lost:
        needs = " and ".join(EFFECTS[lost[0]].needs or ("Fxr",))
        raise BadInput(f"effect '{lost[0]}' needs the column {needs}, which a run lacks; add it or leave the effect.")
    problem, fit, at = fit_effects(with_nominal_noise(problem), selected)
    last = scores(problem, at, fit.theta, selected, seed)
    on = [f"{problem.effects[i].name}.{p.name}" for i in selected for p in problem.effects[i].parameters]
    columns = problem.columns(selected)
    bound = tuple(name for name, end in zip(on, at_bound(problem, fit.theta)[columns], strict=True) if end)
    gain = calibration_gain(problem, selected, tuple(run.name for run in runs), held_out, seed)
    return Calibration(vehicle, problem, selected, fit, last, half_widths(problem, last, selected), bound, gain)


def calibration_gain(
    problem: Problem, selected: tuple[int, ...], names: tuple[str, ...], held_out: int, seed: int
) -> Gain | None:
    """Return the gain on every `held_out`-th run of the effects `selected`, fitted without those runs.

    Noise and observer are those of the other runs too.
    """
    use, held = split_runs(len(names), held_out)
    if not len(held):
        return None
    loose, apart = with_nominal_noise(problem.subset(use)), problem.subset(held)
    near, fit, _ = fit_effects(loose, selected)
    bare, test = with_noise(apart, problem.start, loose.noise), with_noise(apart, fit.theta, near.noise)
    ahead = {"nominal": predict(bare, bare.start), "fitted": predict(test, fit.theta)}
    comparison = Comparison(test, ahead, noise_floor(test, fit.theta, ahead["fitted"], seed))
    return compare(comparison, tuple(names[i] for i in held), selected, seed)


def fit_effects(loose: Problem, selected: tuple[int, ...]) -> tuple[Problem, Fit, Linearisation]:
    """Fit the effects `selected`; return the problem with noise re-estimated at the fit, the fit, its linearisation.

    The first car may be far off: in the problem `loose` it is followed with the disturbances that it needs for itself.
    """
    columns = loose.columns(selected)
    rough, _ = refit_to_convergence(loose, require_finite(nominal_fit(loose)), columns)
    anew = with_estimated_noise(loose, rough.theta, np.isin(np.arange(len(loose.owner)), columns))
    return anew, *refit_to_convergence(anew, require_finite(evaluate(anew, rough.theta)), columns)
