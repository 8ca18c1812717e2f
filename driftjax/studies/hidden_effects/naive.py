"""Naive baseline for naming a cause: regression of one-step errors.

Every measured sample is taken for the true state, and the error of the next one (the finite difference of the data
less the model's rate) is regressed on its derivative by each effect. The noise of a sample then stands on
both sides, with opposite signs in errors one step apart: errors in variables, which do not fade with more data
(Ljung 1999, Sec. 7.6). Effects whose derivatives look like differentiated noise, such as delays of a sensor, are
named whatever the true cause.
"""

import jax.numpy as jnp
import numpy as np

from driftjax.diagnosis.fit import Problem, information_and_score
from driftjax.diagnosis.runs import differentiate, fixed_gain, run_observer

RIDGE = 1e-9  # share of an effect's information that keeps its own parameters apart


def naive_gains(problem: Problem) -> np.ndarray:
    """Return the fall (E,) of the sum of squared one-step errors, scaled, by the best step in each effect alone."""
    data, theta = problem.data, problem.start
    believing = fixed_gain(data, 1.0)
    path = run_observer(problem.model, data, theta, believing)
    e, valid = np.asarray(path.e), np.asarray(path.valid)
    spread = np.sqrt((e**2).sum(axis=(0, 1)) / np.maximum(valid.sum(axis=(0, 1)), 1))
    white = valid[..., None] * np.diag(1 / np.maximum(spread, 1e-12))
    at = differentiate(problem.model, data, theta, believing._replace(whitening=jnp.asarray(white)), problem.active)
    H, b = information_and_score(at)
    return np.array([_fall(problem, H, b, problem.columns((i,))) for i in range(len(problem.effects))])


def _fall(problem: Problem, H: np.ndarray, b: np.ndarray, columns: np.ndarray) -> float:
    """Return the fall of the sum of squares by a linear step in those of `columns` with allowed sign."""
    columns = columns[((b > 0) | (problem.lower < 0))[columns] & (np.diag(H) > 0)[columns]]
    if not len(columns):
        return 0.0
    part = H[np.ix_(columns, columns)]
    return float(b[columns] @ np.linalg.solve(part + RIDGE * np.trace(part) * np.eye(len(part)), b[columns]))
