"""Gain on held-out runs: prediction errors of effects named and fitted without them."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from driftjax.core import require
from driftjax.diagnosis.beam import best_parameters, quadratic_cost
from driftjax.diagnosis.comparison import Comparison, comparison_errors
from driftjax.diagnosis.fit import Problem, with_estimated_noise, with_noise
from driftjax.diagnosis.gain import Errors, Share, at_horizons, channel_ratios, excess_shares, predict, ratios
from driftjax.diagnosis.noise_floor import noise_floor
from driftjax.diagnosis.prediction_fit import PredictionFit, fit_to_predictions
from driftjax.diagnosis.predictive_naming import TOLERATED, leaves_errors, name_by_the_better
from driftjax.diagnosis.residual_gp import fit_residual_gp
from driftjax.diagnosis.select import MAX_EFFECTS, Selection
from driftjax.vehicle.effect import EFFECTS, effects_by_name
from driftjax.vehicle.effect.families import FAMILY_OF, MEASUREMENT

BETTER = 0.02  # share of the error by which another car must predict better than the extended one to be the answer
RETUNED = ("friction", "stiffness_front", "stiffness_rear")  # what a person would tune without a diagnosis


def check_held_out(every: int) -> None:
    """Raise `BadInput` unless `every` is 0 or at least 2."""
    require(every == 0 or every >= 2, f"key 'held_out' is {every}; give 0, or 2 or more.")


def check_naming(most: int, unexplained: float, seed: int, without: tuple[str, ...]) -> None:
    """Raise `BadInput` unless these options of naming effects are in their ranges."""
    require(most >= 1, f"key 'most' is {most}; give 1 or more.")
    require(0 < unexplained < 1, f"key 'unexplained' is {unexplained}; give a share between 0 and 1.")
    require(seed >= 0, f"key 'seed' is {seed}; give 0 or more.")
    unknown = sorted(set(without) - set(EFFECTS))
    require(not unknown, f"key 'without' names {unknown}; the catalogue holds {', '.join(EFFECTS)}.")


@dataclass(frozen=True)
class DiagnoseConfig:
    """Options of a diagnosis."""

    held_out: int = 3
    """Every so-many-th run is held out to measure the gain on: effects are named and fitted once more without them.
    0: none is, and no gain is measured."""
    without: tuple[str, ...] = ()
    """Effects left out of the catalogue."""
    most: int = MAX_EFFECTS
    """Effects named at most."""
    unexplained: float = TOLERATED
    """Share of the excess open-loop error that may stay unexplained: the verdict is UNKNOWN only where more does."""
    gp: bool = True
    """Whether the gain is also measured of a GP, alone and beside the named effects."""
    seed: int = 0
    """Of the random signs of the test and of the resampling."""
    beside: tuple[str, ...] = ()
    """Effects on request to look for too: tyre_curve_front, tyre_curve_rear. Takes many times as long."""

    def __post_init__(self) -> None:
        effects_by_name(self.beside)  # raises for an unknown one
        check_held_out(self.held_out)
        check_naming(self.most, self.unexplained, self.seed, self.without)


@dataclass(frozen=True)
class PredictionGain:
    """Gain of the extended car on held-out runs, named and fitted without them."""

    held_out: tuple[str, ...]  # names of the runs held out
    named: tuple[str, ...]  # effects named without them
    comparison: Comparison  # models compared on them
    errors: dict[str, Errors]  # of each
    noise_floor: Errors  # what noise alone makes
    skills: dict[str, Share]  # of each, at the decisive horizon; empty where no run lasts that long
    ratios: dict[str, np.ndarray]  # (horizons, 3) of errors over those of the nominal car, with intervals
    by_predictions: bool  # whether an observer of long memory named the effects
    refitted: bool  # whether the sizes of the named effects are fitted to predictions
    without: dict[str, np.ndarray]  # (3, 3) per channel: error without one of `named`, over that with all; intervals

    @property
    def best(self) -> str:
        """Return which of the nominal, the re-tuned and the extended car predicts best, the extended one if in doubt.

        By the mean of all channels and horizons.
        """
        mean = {name: float(np.nanmean(np.log(self.ratios[name][:, 0]))) for name in ("retuned", "extended")}
        mean["nominal"] = 0.0
        least = min(mean, key=lambda name: mean[name])
        return least if mean["extended"] > mean[least] + BETTER else "extended"


def split_runs(num: int, every: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the training runs and of the held-out runs (none for fewer than `every` runs)."""
    runs = np.arange(num)
    held = runs % every == every - 1 if every else np.zeros(num, bool)
    return runs[~held], runs[held]


def split_problem(problem: Problem, use: np.ndarray, held: np.ndarray) -> tuple[Problem, Problem]:
    """Return the problems over the runs `use` and over the runs `held`, both with the noise estimated from `use`."""
    train = with_estimated_noise(problem.subset(use), problem.start, problem.active)
    return train, with_noise(problem.subset(held), problem.start, train.noise)


def measure_gain(problem: Problem, names: tuple[str, ...], config: DiagnoseConfig) -> PredictionGain | None:
    """Measure open-loop errors and skills on the held-out runs; None where no run is held out.

    Models are the nominal, the re-tuned and the extended car, and the first and last with a GP on their residuals.

    Noise, and with it the observer that predictions start from and the floor, is estimated without the runs held out:
    that of `problem` is not used.
    """
    use, held = split_runs(len(names), config.held_out)
    if not len(held):
        return None
    train, test = split_problem(problem, use, held)
    naming, own = name_by_the_better(train, config.seed, config.most, config.unexplained)
    near, selection = naming.problem, naming.selection
    followed = test
    if near is not train:
        followed = with_noise(test, selection.nominal.theta, selection.base.noise)
        test = with_noise(test, selection.fit.theta, near.noise)
    sizes = fit_sizes(near, selection, own, config) if own else None
    extended = sizes.theta if sizes else selection.fit.theta
    thetas = {"nominal": selection.nominal.theta, "retuned": refit_retuned(selection).theta, "extended": extended}
    tests = {"nominal": followed, "retuned": followed, "extended": test}
    ahead = {name: predict(tests[name], theta) for name, theta in thetas.items()}
    for name, base in (("gp", "nominal"), ("extended_gp", "extended")) if config.gp else ():
        ahead[name] = predict(tests[base], thetas[base], fit_residual_gp(train, thetas[base], config.seed))
    noise = noise_floor(test, extended, ahead["extended"], config.seed)
    gain = compare_models(
        Comparison(test, ahead, noise), tuple(names[i] for i in held), selection.selected, config.seed
    )
    without = leave_one_out(near, selection, sizes, test, gain.errors["extended"], config.seed)
    return dataclasses.replace(gain, by_predictions=naming.by_predictions, refitted=sizes is not None, without=without)


def retuned_effects(problem: Problem) -> tuple[int, ...]:
    """Return the active effects among those that a person would tune without a diagnosis."""
    return tuple(
        i
        for i, one in enumerate(problem.effects)
        if one.name in RETUNED and problem.active[problem.columns((i,))].all()
    )


def refit_retuned(selection: Selection) -> PredictionFit:
    """Return the nominal car of a search with friction and stiffness fitted to predictions, as a person tunes a car."""
    base = selection.base
    return fit_to_predictions(base, (selection.nominal.theta,), base.columns(retuned_effects(base)))


def fit_sizes(
    problem: Problem, selection: Selection, comparison: Comparison, config: DiagnoseConfig
) -> PredictionFit | None:
    """Fit the sizes of the named effects to predictions where those by the likelihood mislead; None elsewhere.

    They do where they leave more than the tolerated share of the error as an excess, on the runs of `comparison` from
    which the effects were named (fitted without each part, where that can be), and other sizes lower the error by as
    much: those of a right car do not.
    """
    if not leaves_errors(comparison, config.unexplained, config.seed):
        return None
    sizes = refit_extended(problem, selection)
    return sizes if sizes.lowered < 1 - config.unexplained else None


def refit_extended(problem: Problem, selection: Selection) -> PredictionFit:
    """Return the sizes of the named effects of the car that predict best.

    Those of sensors follow from kinematics, whatever the car, and stay.
    """
    of_car = tuple(i for i in selection.selected if FAMILY_OF[problem.effects[i].name] not in MEASUREMENT)
    columns, likely = problem.columns(of_car), selection.fit.theta
    nominal = likely.copy()
    nominal[columns] = problem.start[columns]
    return fit_to_predictions(problem, (likely, nominal), columns)


def leave_one_out(
    train: Problem, selection: Selection, sizes: PredictionFit | None, test: Problem, all_errors: Errors, seed: int
) -> dict[str, np.ndarray]:
    """Return per named effect the errors on `test` without it, others refitted, over those with all (`all_errors`).

    `sizes` are those of a fit to predictions, if there was one. (3, 3): a row per channel at the decisive horizon,
    ratio and 95 % interval.
    """
    model, errors_over_all = quadratic_cost(train, selection.fit, selection.linearisation), {}
    for member in selection.selected:
        if sizes:
            theta = sizes.without(train, train.columns((member,)))
        else:
            theta = train.start + best_parameters(model, tuple(i for i in selection.selected if i != member))
        less = at_horizons(test, predict(test, theta).error ** 2)
        errors_over_all[train.effects[member].name] = channel_ratios(all_errors, less, seed)
    return errors_over_all


def compare_models(
    comparison: Comparison, held: tuple[str, ...], selected: tuple[int, ...], seed: int
) -> PredictionGain:
    """Compare the models of `comparison` on the runs `held`: errors and skills; `selected` were fitted without them."""
    problem = comparison.problem
    errors, least = comparison_errors(comparison)
    others = {name: one for name, one in errors.items() if name != "nominal"}
    shares = excess_shares(errors, least, seed)
    relative = {name: ratios(errors["nominal"], one, seed) for name, one in others.items()}
    return PredictionGain(
        held, tuple(problem.effects[i].name for i in selected), comparison, errors, least, shares, relative,
        by_predictions=False, refitted=False, without={},
    )  # fmt: skip
