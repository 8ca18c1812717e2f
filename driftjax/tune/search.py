"""Two searches: damped Gauss-Newton steps that must lower the true loss, and random sampling."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Evaluate = Callable[[Float[np.ndarray, "K P"]], Float[np.ndarray, " K"]]
Slope = Callable[[Float[np.ndarray, " P"]], tuple[Float[np.ndarray, " P"], Float[np.ndarray, "P P"]]]
DAMPINGS = np.array([1e-2, 1e-1, 1.0, 10.0])  # tried in parallel, relative to the mean curvature
REACH = np.log(1.6)  # largest change of a parameter per step: gradients of a lap are local
HARDER = 1e3  # factor on the dampings where none of the steps is better
GIVE_UP = 2  # rounds of trials in a row without a better point


class Search(NamedTuple):
    """Best point, and the history of the search."""

    p: Float[np.ndarray, " P"]
    loss: float
    cost: int  # evaluations, a gradient counted as one and one more for each parameter
    history: list[tuple[int, float]]  # cost so far, best loss so far


def descend(evaluate: Evaluate, slope: Slope, box: Float[np.ndarray, " P"], budget: int) -> Search:
    """Run Levenberg-Marquardt from 0 within +-`box`, until `budget` would be exceeded or no step is better.

    Steps of several dampings are tried in parallel, and the best is accepted where it lowers `evaluate`, the true loss;
    a misleading gradient (of a smoothed lap, or of some of the plants) costs trials but never makes the result worse.
    """
    p = np.zeros_like(box)
    loss, cost = float(evaluate(p[None])[0]), 1
    history, gradient, failures, harder = [(cost, loss)], None, 0, 1.0
    while failures < GIVE_UP:
        num_evaluations = len(DAMPINGS) + (1 + len(box) if gradient is None else 0)
        if cost + num_evaluations > budget:
            break
        if gradient is None:
            gradient = slope(p)
        trials = np.array([_step(p, *gradient, harder * damping, box) for damping in DAMPINGS])
        losses, cost = evaluate(trials), cost + num_evaluations
        best = int(np.argmin(losses))
        if losses[best] < loss:
            p, loss, gradient, failures, harder = trials[best], float(losses[best]), None, 0, 1.0
        else:
            failures, harder = failures + 1, harder * HARDER
        history.append((cost, loss))
    return Search(p, loss, cost, history)


def _step(p: np.ndarray, gradient: np.ndarray, gauss: np.ndarray, damping: float, box: np.ndarray) -> np.ndarray:
    size = max(float(np.trace(gauss)) / len(p), 1e-12)
    step = -np.linalg.solve(gauss + damping * size * np.eye(len(p)), gradient)
    step *= min(1.0, REACH / max(float(np.abs(step).max()), 1e-12))
    return np.clip(p + step, -box, box)


def random_search(evaluate: Evaluate, box: Float[np.ndarray, " P"], budget: int, seed: int) -> Search:
    """Return the best of 0 and `budget` - 1 points uniform in +-`box`: factors are log-uniform."""
    draws = np.random.default_rng(seed).uniform(-box, box, (budget - 1, len(box)))
    points = np.concatenate([np.zeros((1, len(box))), draws])
    losses = evaluate(points)
    lowest = np.minimum.accumulate(losses)
    best = int(np.argmin(losses))
    return Search(points[best], float(losses[best]), budget, [(i + 1, float(v)) for i, v in enumerate(lowest)])
