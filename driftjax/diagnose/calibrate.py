"""The nominal car fitted to data: effects that one believes in get their sizes, without asking whether they act."""

from typing import NamedTuple

import numpy as np

from driftjax.core import BadInput
from driftjax.data import Run
from driftjax.diagnose.approach import kept
from driftjax.diagnose.diagnosis import Gain, split
from driftjax.diagnose.evidence import half_widths
from driftjax.diagnose.fit import Fit, Problem, observed, posed, priced, settle, tuned
from driftjax.diagnose.floor import floor
from driftjax.diagnose.gain import at_horizons, predict, skill
from driftjax.diagnose.score import Scores, scores
from driftjax.diagnose.show import Judged
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
    task, fit = fitted(task, members)
    fit, at = settle(task, fit, task.columns(members))
    last = scores(task, at, fit.theta, members, seed)
    on = [f"{task.effects[i].name}.{p.name}" for i in members for p in task.effects[i].parameters]
    columns = task.columns(members)
    ends = (fit.theta == task.lower) & (task.lower != 0) | (fit.theta == task.upper)
    bound = tuple(name for name, end in zip(on, ends[columns], strict=True) if end)
    gain = gained(task, members, tuple(run.name for run in runs), held_out, seed)
    return Calibration(task, members, fit, last, half_widths(task, last, members), bound, gain)


def gained(task: Problem, members: tuple[int, ...], names: tuple[str, ...], held_out: int, seed: int) -> Gain | None:
    """What the effects `members`, fitted without every `held_out`-th run, gain on those."""
    use, held = split(len(names), held_out)
    if not len(held):
        return None
    near, fit = fitted(task.part(use), members)
    test = observed(task.part(held), fit.theta, near.noise)
    ahead = {"nominal": predict(followed(task.part(held), task.start), task.start), "fitted": predict(test, fit.theta)}
    errors = {name: at_horizons(test, one.error**2) for name, one in ahead.items()}
    noise = floor(test, fit.theta, ahead["fitted"], seed)
    least = at_horizons(test, noise)
    skills = {"fitted": skill(errors["nominal"], errors["fitted"], least, seed)}
    named = tuple(task.effects[i].name for i in members)
    return Gain(tuple(names[i] for i in held), named, Judged(test, ahead, noise), errors, least, skills)


def followed(task: Problem, theta: np.ndarray) -> Problem:
    """The problem with the noise that the car `theta` needs, nothing explained away."""
    return tuned(task, theta, np.zeros_like(task.asked))


def fitted(task: Problem, members: tuple[int, ...]) -> tuple[Problem, Fit]:
    """The best fit over `members`, in the problem whose noise is what the car so fitted leaves.

    The first car may be far off: it is followed with the disturbances that it needs for itself.
    """
    columns = task.columns(members)
    loose = followed(task, task.start)
    rough, _ = settle(loose, kept(priced(loose, task.start)), columns)
    anew = tuned(task, rough.theta, np.isin(np.arange(len(task.owner)), columns))
    return anew, settle(anew, kept(priced(anew, rough.theta)), columns)[0]
