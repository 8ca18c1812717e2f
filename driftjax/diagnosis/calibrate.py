"""The nominal car fitted to data: effects that one believes in get their sizes, without asking whether they act."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from driftjax.core import BadInput, require
from driftjax.diagnosis.evidence import half_widths
from driftjax.diagnosis.fit import Fit, Problem, observed, posed, priced, settle, tuned
from driftjax.diagnosis.gain import predict
from driftjax.diagnosis.held_out import Gain, check_held_out, compared, split
from driftjax.diagnosis.multistart import kept, loosened, nominal
from driftjax.diagnosis.noise_floor import floor
from driftjax.diagnosis.runs import Followed
from driftjax.diagnosis.score import Scores, scores
from driftjax.diagnosis.serialise import extended_car, gain_json
from driftjax.diagnosis.show import Judged
from driftjax.environment import require_float64
from driftjax.logs import Log
from driftjax.store.files import write_json
from driftjax.vehicle import VehicleConfig, write_vehicle
from driftjax.vehicle.effect import EFFECTS, Effect, effects_by_name

USUAL = ("friction", "stiffness_front", "stiffness_rear", "drive_gain", "steer_offset")


class FittedParameter(NamedTuple):
    """One parameter of a calibration, SI."""

    parameter: str  # effect.parameter
    value: float
    ci95_half: float  # half-width of its 95 % interval
    unit: str
    at_bound: bool  # these data ask for more


@dataclass(frozen=True)
class Calibration:
    """A car fitted to data, and what that gains on runs that had no part in it; `str` is its table."""

    nominal: VehicleConfig
    task: Problem  # with noise and observer of the fitted car
    members: tuple[int, ...]  # effects that were fitted, numbers in the catalogue
    fit: Fit
    scores: Scores
    half_width: np.ndarray  # (k,) of the 95 % intervals, in typical sizes
    bound: tuple[str, ...]  # parameters that ended on a bound of theirs
    gain: Gain | None  # on runs held out, of a car fitted without them; None where there are too few

    @property
    def vehicle(self) -> VehicleConfig:
        """The calibrated car, for simulator, planner, equilibria, MPC and `diagnose`."""
        return extended_car(self.nominal, self.task, self.members, self.fit.theta, self.scores)

    @property
    def parameters(self) -> tuple[FittedParameter, ...]:
        """Every parameter fitted, SI."""
        task = self.task
        columns, scale = task.columns(self.members), np.asarray(task.model.scale)
        names = [(task.effects[i].name, p) for i in self.members for p in task.effects[i].parameters]
        values, widths = self.fit.theta[columns] * scale[columns], self.half_width * scale[columns]
        return tuple(
            FittedParameter(f"{name}.{p.name}", float(value), float(half), p.unit, f"{name}.{p.name}" in self.bound)
            for (name, p), value, half in zip(names, values, widths, strict=True)
        )

    def content(self) -> dict[str, Any]:
        """Return what calibration.json holds."""
        noise = self.task.noise
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
    vehicle: VehicleConfig, log: Log, effects: Sequence[str] = USUAL, *, held_out: int = 3, seed: int = 0,
    catalogue: tuple[Effect, ...] = tuple(EFFECTS.values()),
) -> Calibration:  # fmt: skip
    """Fit the `effects` of the car to a log in which it should be right; others stay as `vehicle` has them.

    Nothing is tested here: what `diagnose` should find later is to be left out. Every `held_out`-th run is held out
    to measure the gain on, by a fit of its own; 0: none is. Raises `BadInput` for effects that these runs cannot tell.
    """
    require_float64()
    check_held_out(held_out)
    require(bool(effects), "key 'effects' is empty; name the effects to fit.")
    runs, names = log.runs, tuple(effects)
    wanted = {effect.name for effect in effects_by_name(names)}
    task = posed(vehicle, catalogue, runs)
    members = tuple(i for i, effect in enumerate(task.effects) if effect.name in wanted)
    lost = [task.effects[i].name for i in members if not task.asked[task.columns((i,))].all()]
    if lost:
        needs = " and ".join(EFFECTS[lost[0]].needs)
        raise BadInput(f"effect '{lost[0]}' needs the column {needs}, which a run lacks; add it or leave the effect.")
    task, fit, at = fitted(loosened(task), members)
    last = scores(task, at, fit.theta, members, seed)
    on = [f"{task.effects[i].name}.{p.name}" for i in members for p in task.effects[i].parameters]
    columns = task.columns(members)
    ends = (fit.theta == task.lower) & (task.lower != 0) | (fit.theta == task.upper)
    bound = tuple(name for name, end in zip(on, ends[columns], strict=True) if end)
    gain = gained(task, members, tuple(run.name for run in runs), held_out, seed)
    return Calibration(vehicle, task, members, fit, last, half_widths(task, last, members), bound, gain)


def gained(task: Problem, members: tuple[int, ...], names: tuple[str, ...], held_out: int, seed: int) -> Gain | None:
    """What the effects `members`, fitted without every `held_out`-th run, gain on those.

    Noise and observer are those of the other runs too.
    """
    use, held = split(len(names), held_out)
    if not len(held):
        return None
    loose, apart = loosened(task.part(use)), task.part(held)
    near, fit, _ = fitted(loose, members)
    bare, test = observed(apart, task.start, loose.noise), observed(apart, fit.theta, near.noise)
    ahead = {"nominal": predict(bare, bare.start), "fitted": predict(test, fit.theta)}
    judged = Judged(test, ahead, floor(test, fit.theta, ahead["fitted"], seed))
    return compared(judged, tuple(names[i] for i in held), members, seed)


def fitted(loose: Problem, members: tuple[int, ...]) -> tuple[Problem, Fit, Followed]:
    """The best fit over `members` with its derivatives, in the problem whose noise is what the car so fitted leaves.

    The first car may be far off: in the problem `loose` it is followed with the disturbances that it needs for itself.
    """
    columns = loose.columns(members)
    rough, _ = settle(loose, kept(nominal(loose)), columns)
    anew = tuned(loose, rough.theta, np.isin(np.arange(len(loose.owner)), columns))
    return anew, *settle(anew, kept(priced(anew, rough.theta)), columns)
