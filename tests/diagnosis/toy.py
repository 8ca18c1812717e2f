"""Problems of a few hundred numbers in place of a car: what a search does with costs that are not quadratic."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from driftjax.diagnosis import contrast, multistart, naming, refine, rivals, select
from driftjax.diagnosis import fit as fits
from driftjax.diagnosis.cross_validate import fits_left_out, left_out_blocks
from driftjax.diagnosis.fit import Fit, Problem
from driftjax.diagnosis.gain import Errors
from driftjax.diagnosis.noise import PRIOR
from driftjax.diagnosis.runs import Linearisation, Pieces

NOTHING: Any = None
BLOCKS, LENGTH = 24, 8  # in one run
STEP = 1e-6  # of central differences


def toy_problem(
    monkeypatch: pytest.MonkeyPatch, residuals: Callable, lower: np.ndarray, upper: np.ndarray, runs: int = 1
) -> tuple[Problem, Fit]:
    """A problem of one-parameter effects a, b, c ... whose whitened innovations (P, T, 3) are `residuals(theta)`.

    And the fit of its nominal car.
    """
    K = len(lower)
    block = np.arange(runs * BLOCKS).repeat(LENGTH).reshape(runs, -1)
    padded: Any = SimpleNamespace(valid=np.ones((runs, BLOCKS * LENGTH, 3)))
    data = Pieces(padded, np.arange(runs), block, runs * BLOCKS, 0.1)
    model: Any = SimpleNamespace(effects=tuple(SimpleNamespace(name="abcdefgh"[i]) for i in range(K)))

    def evaluate(problem: Problem, theta: np.ndarray) -> Fit:
        e = residuals(theta)
        return Fit(theta, float(np.sum(e**2) + np.sum((theta - problem.start) ** 2) / PRIOR**2), e)

    def linearise(problem: Problem, fit: Fit) -> Linearisation:
        pairs = [(residuals(fit.theta - h), residuals(fit.theta + h)) for h in STEP * np.eye(K)]
        J = np.stack([low - high for low, high in pairs], axis=-1) / (2 * STEP)
        return Linearisation(fit.e, J, NOTHING, NOTHING)  # type: ignore[arg-type]

    def held_out_errors(problem: Problem, fit: Fit, at: Linearisation, selected: tuple[int, ...]) -> Errors | None:
        """The residuals themselves stand for open-loop errors, alike at all horizons."""
        if (out := left_out_blocks(data, 1)) is None:
            return None
        e = np.concatenate(
            [residuals(theta)[p] for p, theta in enumerate(fits_left_out(problem, fit, at, selected, out))]
        )
        return Errors(
            np.repeat(e[:, None] ** 2, 4, axis=1), (), block.ravel(), np.repeat(np.arange(runs), block.shape[1])
        )

    monkeypatch.setattr(select, "held_out_errors", held_out_errors)
    for module in (contrast, fits, select, naming, multistart):
        monkeypatch.setattr(module, "evaluate_fit", evaluate)
    for module in (fits, refine, select, rivals, multistart):
        monkeypatch.setattr(module, "evaluate_fits", lambda problem, thetas: [evaluate(problem, one) for one in thetas])
    for module in (contrast, refine, select):
        monkeypatch.setattr(module, "linearise", linearise)
    known = np.zeros(K), np.arange(K), frozenset[str](), np.ones(K, bool)
    problem = Problem(model, data, lower, upper, *known, NOTHING, NOTHING)
    return problem, evaluate(problem, problem.start)
