"""The nominal car fitted to data: effects that one believes in get their sizes, without asking whether they act."""

from typing import NamedTuple

import numpy as np

from driftjax.core import BadInput
from driftjax.diagnosis.diagnose import Gain, compared, split
from driftjax.diagnosis.evidence import half_widths
from driftjax.diagnosis.fit import Fit, Problem, observed, posed, priced, settle, tuned
from driftjax.diagnosis.gain import predict
from driftjax.diagnosis.multistart import kept, loosened, nominal
from driftjax.diagnosis.noise_floor import floor
from driftjax.diagnosis.runs import Followed
from driftjax.diagnosis.score import Scores, scores
from driftjax.diagnosis.show import Judged
from driftjax.logs import Run
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import EFFECTS, Effect, effects_named


class Calibration(NamedTuple):
    """A car fitted to data, and what that gains on runs that had no part in it."""

    task: Problem  # with noise and observer of the fitted car
    members: tuple[int, ...]  # effects that were fitted, numbers in the catalogue
    fit: Fit
    scores: Scores
    half_width: np.ndarray  # (k,) of the 95 % intervals, in typical sizes
    bound: tuple[str, ...]  # parameters that ended on a bound of theirs
    gain: Gain | None  # on runs held out, of a car fitted without them; None where there are too few


def calibrate(
    vehicle: VehicleConfig, runs: tuple[Run, ...], names: tuple[str, ...], held_out: int = 3, seed: int = 0,
    effects: tuple[Effect, ...] = tuple(EFFECTS.values()),
) -> Calibration:  # fmt: skip
    """The effects `names` of the car at their best in `runs`; others stay as `vehicle` has them.

    Every `held_out`-th run is held out to measure the gain on, by a fit of its own; 0: none is. `effects` is the
    catalogue; raises `BadInput` for effects that these runs cannot tell.
    """
    wanted = {effect.name for effect in effects_named(names)}
    task = posed(vehicle, effects, runs)
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
    return Calibration(task, members, fit, last, half_widths(task, last, members), bound, gain)


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
