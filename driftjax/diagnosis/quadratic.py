"""Quadratic functions of a few variables within bounds."""

import numpy as np

ROUNDING = 1e-9  # of the pull on a variable at its bound, over the largest term that it is the sum of
MOST = 10  # iterations of bounded least squares, times the number of variables


def minimise_quadratic(g: np.ndarray, H: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the minimiser (n,) of psi H psi - 2 g psi within bounds (n,), `H` (n, n) positive definite.

    What would pass a bound is put on it, and the others are solved for again. Where that leaves a variable on a bound
    that the function pulls it away from, bounded least squares decide (Stark and Parker 1995, as in SciPy).
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
    pull = g - H @ psi
    inward = np.where(psi <= lower, pull, 0.0) + np.where(psi >= upper, -pull, 0.0)
    rounding = ROUNDING * (np.abs(g) + np.abs(H) @ np.abs(psi))
    return _bounded_least_squares(g, H, lower, upper) if (inward > rounding)[lower < upper].any() else psi


def _bounded_least_squares(g: np.ndarray, H: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the same minimiser: with H = F^T F, that of |F psi - F^-T g|^2; equal bounds fix a variable."""
    from scipy.optimize import lsq_linear  # takes a second to load, with every command and worker

    psi, free = np.array(lower, float), np.flatnonzero(lower < upper)
    fixed = np.flatnonzero(lower >= upper)
    F = np.linalg.cholesky(H[np.ix_(free, free)]).T
    right = np.linalg.solve(F.T, g[free] - H[np.ix_(free, fixed)] @ psi[fixed])
    found = lsq_linear(F, right, (lower[free], upper[free]), method="bvls", max_iter=MOST * len(free))
    side = found.active_mask.astype(int) + 1  # on a bound exactly, where the solver is off by rounding
    psi[free] = np.choose(side, (lower[free], found.x, upper[free]))
    return psi
