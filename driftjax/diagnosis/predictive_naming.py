"""Name the effects of a log: by single steps, and where these leave errors, by an observer of long memory."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.comparison import Comparison, compare_on_own_runs, comparison_shares
from driftjax.diagnosis.cross_validate import Change, change_of, fits_left_out, left_out
from driftjax.diagnosis.fit import Fit, Problem
from driftjax.diagnosis.gain import DECISIVE, Errors, at_horizons, horizon_steps, predict
from driftjax.diagnosis.memory import with_long_memory
from driftjax.diagnosis.multistart import nominal_fit
from driftjax.diagnosis.naming import name_effects, prefer_probable, with_significance
from driftjax.diagnosis.runs import Linearisation
from driftjax.diagnosis.select import FIRST, LEVEL, Selection, search

TOLERATED = 0.1  # share of the error that may stay unexplained, unless options give another


class Naming(NamedTuple):
    """Named effects of a log."""

    problem: Problem  # from the states of whose observer predictions start
    selection: Selection  # its nominal car is that of this observer, too
    searched: Problem  # in whose observer the effects were searched and fitted
    found: Selection  # the result of that search

    @property
    def by_predictions(self) -> bool:
        """Return whether an observer of long memory named the effects."""
        return self.searched is not self.problem

    def with_found(self, found: Selection) -> "Naming":
        """Return the naming with another result of the search."""
        kept = {name: getattr(self.selection, name) for name in ("base", "nominal", "nominal_scores")}
        return self._replace(selection=found._replace(**kept), found=found)


def name_by_steps(problem: Problem, seed: int, most: int, report: Callable[[str], None] = lambda text: None) -> Naming:
    """Name effects by the likelihood of single steps."""
    near, selection = name_effects(problem, seed, most, report)
    return Naming(near, selection, near, selection)


def leaves_errors(comparison: Comparison, tolerated: float, seed: int) -> bool:
    """Return whether the extended car leaves more than the share `tolerated` of its error as an excess over noise.

    That noise should be the sensors' alone: estimated disturbances would excuse what the car gets wrong.
    """
    shares = comparison_shares(comparison, seed)
    return "extended" in shares and shares["extended"].remaining > tolerated


def name_by_predictions(
    named: Naming, seed: int, most: int, report: Callable[[str], None] = lambda text: None
) -> Naming | None:
    """Name effects with an observer of long memory; None where there is none, or where it finds nothing.

    Every effect must predict parts left out of the fit better, but for those of pose and accelerations. No other test
    leaves any out; those that are not significant in their blocks of time are exploratory.
    """
    long = with_long_memory(named.problem)
    if long is None:
        return None
    found = search(long, nominal_fit(long), seed, most=most, report=report, first=0)
    if not found.selected:
        return None
    found = prefer_probable(long, found._replace(free=FIRST + found.free), seed)
    return named._replace(searched=long).with_found(with_significance(long, found)[0])


def name_by_the_better(
    problem: Problem, seed: int, most: int, tolerated: float, report: Callable[[str], None] = lambda text: None
) -> tuple[Naming, Comparison | None]:
    """Name effects by single steps, and by predictions where these leave errors; return those that predict better.

    Predictions must lower the error by more than the share `tolerated` of it: of a right car, single steps give the
    more precise sizes. The comparison is that of the nominal and the extended car on the runs that the effects are
    named from, the latter fitted without the part that it predicts; None where nothing is named.
    """
    named = name_by_steps(problem, seed, most, report)
    if not named.selection.selected and named.selection.scores.p_value >= LEVEL:
        return named, None
    own = _compare(named, seed)
    if leaves_errors(own, tolerated, seed):
        other = name_by_predictions(named, seed, most, report)
        if other is not None:
            better = _compare(other, seed)
            change = error_change(own, better)
            if change.improves and change.total < np.log1p(-tolerated):
                named, own = other, better
    return named, own if named.selection.selected else None


def _compare(named: Naming, seed: int) -> Comparison:
    """Compare the nominal and the extended car on own runs, the latter fitted without the part that it predicts."""
    selection, found = named.selection, named.found
    own = compare_on_own_runs(
        selection.base, selection.nominal.theta, named.problem, found.fit.theta, seed, disturbed=False
    )
    return without_own_parts(own, named.searched, found.fit, found.linearisation, found.selected)


def without_own_parts(
    own: Comparison, searched: Problem, fit: Fit, linearisation: Linearisation, selected: tuple[int, ...]
) -> Comparison:
    """Return the comparison with an extended car that is fitted without the part that it predicts.

    The effects `selected` were fitted in the problem `searched`. They stay fitted to all parts where the log is too
    short to leave any out.
    """
    out = left_out(own.problem)
    if out is None:
        return own
    theta = fits_left_out(searched, fit, linearisation, selected, out)
    return own._replace(predictions=own.predictions | {"extended": predict(own.problem, theta)})


def error_change(own: Comparison, other: Comparison) -> Change:
    """Return the change from the errors of the extended car of `own` to those of that of `other`."""
    return change_of(_errors(own), _errors(other))


def _errors(own: Comparison) -> Errors:
    """Return the errors of the extended car up to the horizon at which shares of the error are measured."""
    num = horizon_steps(own.problem)[DECISIVE]
    return at_horizons(own.problem, own.predictions["extended"].error[:, :, :num] ** 2)
