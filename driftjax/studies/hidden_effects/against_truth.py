"""Compare the search of a diagnosis with the true effects: their scores at the nominal car, and penalised costs."""

from collections.abc import Sequence

import numpy as np

from driftjax.diagnosis.diagnose import Evidence
from driftjax.diagnosis.fit import Problem, evaluate_fit
from driftjax.diagnosis.refine import refit_to_convergence
from driftjax.diagnosis.select import penalised_cost


def nominal_scores(evidence: Evidence, names: set[str]) -> dict[str, dict[str, float]]:
    """Return the scores at the nominal car of the effects `names` and of those that the diagnosis named.

    By effect: largest score `T`, promised `gain`, `rank` among all effects by gain (0 the best), and `deviations`, the
    largest square root of a parameter's information.
    """
    problem, at = evidence.problem, evidence.selection.nominal_scores
    order = [effect.name for effect in problem.effects]
    content = {}
    for name in {*names, *(order[i] for i in evidence.selection.selected)}:
        i = order.index(name)
        columns = problem.columns((i,))
        content[name] = {
            "T": float(np.abs(at.T[columns]).max()), "gain": float(at.gain[i]),
            "rank": int((at.gain > at.gain[i]).sum()), "deviations": float(np.sqrt(np.diag(at.H)[columns].max())),
        }  # fmt: skip
    return content


def penalised_costs(
    evidence: Evidence, truth: dict[str, dict[str, float]], unknown: Sequence[str] = ()
) -> dict[str, float]:
    """Return the penalised costs of the `named` effects and of the `truth`, both with fitted parameters.

    `truth` maps effect -> parameter -> value, SI. Effects that act too, but with `unknown` parameters, start at their
    typical size.
    """
    return costs_against(evidence, *_true_start(evidence.problem, truth, unknown))


def costs_against(evidence: Evidence, start: np.ndarray, members: tuple[int, ...]) -> dict[str, float]:
    """Return the penalised costs of the `named` effects and of the true `members`, refitted from `start` (K,).

    Both are those of the observer that named the effects.
    """
    problem, selection = evidence.naming.searched, evidence.naming.found
    fit = evaluate_fit(problem, start)
    fit = refit_to_convergence(problem, fit, problem.columns(members))[0] if members else fit
    return {
        "named": penalised_cost(problem, selection.fit, selection.selected),
        "truth": penalised_cost(problem, fit, members),
    }


def _true_start(
    problem: Problem, truth: dict[str, dict[str, float]], unknown: Sequence[str]
) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the true parameters in typical sizes, and the numbers of the effects that act."""
    names = [effect.name for effect in problem.effects]
    theta = [truth.get(effect.name, {}).get(p.name, 0.0) for effect in problem.effects for p in effect.parameters]
    others = tuple(map(names.index, unknown))
    start = np.array(theta) / np.asarray(problem.model.scale)
    start[problem.columns(others)] = 1.0
    return start, tuple(sorted((*map(names.index, truth), *others)))
