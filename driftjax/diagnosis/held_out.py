"""Gain on held-out runs: prediction errors of effects named and fitted without them."""

from dataclasses import dataclass

import numpy as np

from driftjax.core import require
from driftjax.diagnosis.findings import Comparison
from driftjax.diagnosis.fit import Problem, initial_problem, refit_to_convergence, with_estimated_noise, with_noise
from driftjax.diagnosis.gain import Errors, at_horizons, predict, ratios, skill
from driftjax.diagnosis.multistart import search_multistart
from driftjax.diagnosis.noise_floor import noise_floor
from driftjax.diagnosis.residual_gp import fit_residual_gp
from driftjax.diagnosis.select import MAX_EFFECTS, Selection
from driftjax.logs import Run
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import EFFECTS, Effect

RETUNED = ("friction", "stiffness_front", "stiffness_rear")  # what a person would tune without a diagnosis


def check_held_out(every: int) -> None:
    """Raise `BadInput` unless `every` is 0 or at least 2."""
    require(every == 0 or every >= 2, f"key 'held_out' is {every}; give 0, or 2 or more.")


@dataclass(frozen=True)
class DiagnoseConfig:
    """Options of a diagnosis."""

    held_out: int = 3
    """Every so-many-th run is held out to measure the gain on: effects are named and fitted once more without them.
    0: none is, and no gain is measured."""
    without: tuple[str, ...] = ()
    """Effects left out of the catalogue."""
    most: int = MAX_EFFECTS
    """Effects named at most. Each further one takes longer; a real car that nobody calibrated may need more."""
    gp: bool = True
    """Whether the gain is also measured of a GP, alone and beside the named effects."""
    seed: int = 0
    """Of the random signs of the test and of the resampling."""

    def __post_init__(self) -> None:
        check_held_out(self.held_out)
        require(self.most >= 1, f"key 'most' is {self.most}; give 1 or more.")
        require(self.seed >= 0, f"key 'seed' is {self.seed}; give 0 or more.")
        unknown = sorted(set(self.without) - set(EFFECTS))
        require(not unknown, f"key 'without' names {unknown}; the catalogue holds {', '.join(EFFECTS)}.")


@dataclass(frozen=True)
class Gain:
    """Gain of the extended car on held-out runs, named and fitted without them."""

    held_out: tuple[str, ...]  # names of the runs held out
    named: tuple[str, ...]  # effects named without them
    comparison: Comparison  # models compared on them
    errors: dict[str, Errors]  # of each
    noise_floor: Errors  # what noise alone makes
    skills: dict[str, tuple[float, tuple[float, float]]]
    ratios: dict[str, np.ndarray]  # (horizons, 3) of errors over those of the nominal car, with intervals


def split_runs(num: int, every: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the training runs and of the held-out runs (none for fewer than `every` runs)."""
    runs = np.arange(num)
    held = runs % every == every - 1 if every else np.zeros(num, bool)
    return runs[~held], runs[held]


def measure_from_runs(
    vehicle: VehicleConfig, effects: tuple[Effect, ...], runs: tuple[Run, ...], config: DiagnoseConfig
) -> Gain | None:
    """Build the problem and call `measure_gain`: a worker process builds it itself."""
    return measure_gain(
        initial_problem(vehicle, effects, runs, config.without), tuple(run.name for run in runs), config
    )


def split_problem(problem: Problem, use: np.ndarray, held: np.ndarray) -> tuple[Problem, Problem]:
    """Return the problems over the runs `use` and over the runs `held`, both with the noise estimated from `use`."""
    train = with_estimated_noise(problem.subset(use), problem.start, problem.active)
    return train, with_noise(problem.subset(held), problem.start, train.noise)


def measure_gain(problem: Problem, names: tuple[str, ...], config: DiagnoseConfig) -> Gain | None:
    """Measure open-loop errors and skills on the held-out runs; None where no run is held out.

    Models are the nominal, the re-tuned and the extended car, and the first and last with a GP on their residuals.

    Noise, and with it the observer that predictions start from and the floor, is estimated without the runs held out:
    that of `problem` is not used.
    """
    use, held = split_runs(len(names), config.held_out)
    if not len(held):
        return None
    train, test = split_problem(problem, use, held)
    near, selection = search_multistart(train, config.seed, config.most)
    followed = test
    if near is not train:
        followed = with_noise(test, selection.nominal.theta, selection.base.noise)
        test = with_noise(test, selection.fit.theta, near.noise)
    effects = [effect.name for effect in problem.effects]
    columns = problem.columns(tuple(effects.index(name) for name in RETUNED if name in effects))
    retuned = refit_to_convergence(selection.base, selection.nominal, columns[problem.active[columns]])[0]
    thetas = {"nominal": selection.nominal.theta, "retuned": retuned.theta, "extended": selection.fit.theta}
    tests = {"nominal": followed, "retuned": followed, "extended": test}
    ahead = {name: predict(tests[name], theta) for name, theta in thetas.items()}
    for name, base in (("gp", "nominal"), ("extended_gp", "extended")) if config.gp else ():
        ahead[name] = predict(tests[base], thetas[base], fit_residual_gp(train, thetas[base], config.seed))
    noise = noise_floor(test, selection.fit.theta, ahead["extended"], config.seed)
    return compare(Comparison(test, ahead, noise), tuple(names[i] for i in held), selection.selected, config.seed)


def compare(comparison: Comparison, held: tuple[str, ...], selected: tuple[int, ...], seed: int) -> Gain:
    """Compare the models of `comparison` on the runs `held`: errors and skills; `selected` were fitted without them."""
    problem = comparison.problem
    errors = {name: at_horizons(problem, one.error**2) for name, one in comparison.predictions.items()}
    least = at_horizons(problem, comparison.least)
    others = {name: one for name, one in errors.items() if name != "nominal"}
    skills = {name: skill(errors["nominal"], one, least, seed) for name, one in others.items()}
    relative = {name: ratios(errors["nominal"], one, seed) for name, one in others.items()}
    return Gain(held, tuple(problem.effects[i].name for i in selected), comparison, errors, least, skills, relative)


def compare_on_all_runs(problem: Problem, selection: Selection, seed: int) -> Comparison:
    """Compare the nominal and the extended car on all runs, where none is held out."""
    thetas = {"nominal": selection.nominal.theta, "extended": selection.fit.theta}
    ahead = {name: predict(on, thetas[name]) for name, on in (("nominal", selection.base), ("extended", problem))}
    return Comparison(problem, ahead, noise_floor(problem, selection.fit.theta, ahead["extended"], seed))
