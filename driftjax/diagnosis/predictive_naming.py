"""Name the effects of a log: by single steps, and where these leave errors, by an observer of long memory."""

from collections.abc import Callable
from typing import NamedTuple

from driftjax.diagnosis.comparison import Comparison, compare_on_own_runs, comparison_shares
from driftjax.diagnosis.cross_validate import change_of, fits_left_out, left_out
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import DECISIVE, Errors, at_horizons, predict
from driftjax.diagnosis.memory import with_long_memory
from driftjax.diagnosis.multistart import nominal_fit
from driftjax.diagnosis.naming import name_effects, settle_names
from driftjax.diagnosis.select import FIRST, LEVEL, Selection, search


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
    """Return whether the extended car leaves more than the share `tolerated` of its error as an excess over noise."""
    shares = comparison_shares(comparison, seed)
    return "extended" in shares and shares["extended"].remaining > tolerated


def name_by_predictions(
    named: Naming, seed: int, most: int, report: Callable[[str], None] = lambda text: None
) -> Naming | None:
    """Name effects with an observer of long memory; None where there is none, or where it finds nothing.

    Every effect must predict parts left out of the fit better, but for those of pose and accelerations.
    """
    long = with_long_memory(named.problem)
    if long is None:
        return None
    found = search(long, nominal_fit(long), seed, most=most, report=report, first=0)
    found = settle_names(long, found._replace(free=FIRST + found.free), seed)
    if not found.selected:
        return None
    return named._replace(searched=long).with_found(found)


def name_by_the_better(
    problem: Problem, seed: int, most: int, tolerated: float, report: Callable[[str], None] = lambda text: None
) -> tuple[Naming, Comparison | None]:
    """Name effects by single steps, and by predictions where these leave errors; return those that predict better.

    The comparison is that of the nominal and the extended car on the runs that the effects are named from; None where
    nothing is named.
    """
    named = name_by_steps(problem, seed, most, report)
    if not named.selection.selected and named.selection.scores.p_value >= LEVEL:
        return named, None
    own = _compare(named, seed)
    if leaves_errors(own, tolerated, seed):
        other = name_by_predictions(named, seed, most, report)
        if other is not None and change_of(_errors(named), _errors(other)).improves:
            named, own = other, _compare(other, seed)
    return named, own if named.selection.selected else None


def _compare(named: Naming, seed: int) -> Comparison:
    return compare_on_own_runs(named.problem, named.selection, named.selection.fit.theta, seed)


def _errors(named: Naming) -> Errors:
    """Return open-loop errors on parts left out of the fit; of all parts where the log is too short for that."""
    out = left_out(named.problem)
    theta = named.found.fit.theta
    if out is not None:
        theta = fits_left_out(named.searched, named.found.fit, named.found.linearisation, named.found.selected, out)
    return at_horizons(named.problem, predict(named.problem, theta, last=DECISIVE).error ** 2)
