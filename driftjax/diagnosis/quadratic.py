"""Quadratic functions of a few variables within bounds."""

import numpy as np


def minimise_quadratic(g: np.ndarray, H: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the minimiser (n,) of psi H psi - 2 g psi within bounds (n,).

    What would pass a bound is put on it, and the others are solved for again.
    """
    psi, free = np.zeros(len(g)), np.arange(len(g))
    while len(free):
        bound = np.setdiff1d(np.arange(len(g)), free)
        psi[free] = np.linalg.solve(H[np.ix_(free, free)], g[free] - H[np.ix_(free, bound)] @ psi[bound])
        outside = (psi[free] < lower[free]) | (psi[free] > upper[free])
        if not outside.any():
            break
        psi[free] = np.clip(psi[free], lower[free], upper[free])
        free = free[~outside]
    return psi
