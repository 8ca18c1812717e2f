"""Fit the same Gaussian process by scikit-learn: one output at a time, same start, same bounds."""

from typing import Any

import numpy as np
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from driftjax.gp.fit import LOWER, UPPER

START = (1.0, 1.0, 0.1)  # length scale, amplitude, noise: the first start of `driftjax.gp.fit`


def fit_sklearn(X: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return logarithms (D, nf + 2) of length scales, amplitude and noise for scaled inputs (n, nf), targets (n, D)."""
    (length, amplitude, noise), bounds = START, list(zip(LOWER, UPPER, strict=True))
    squared = lambda pair: (pair[0] ** 2, pair[1] ** 2)
    logs = []
    for y in T.T:
        signal = ConstantKernel(amplitude**2, squared(bounds[1])) * RBF(np.full(X.shape[1], length), bounds[0])  # pyright: ignore[reportArgumentType]
        kernel = signal + WhiteKernel(noise**2, squared(bounds[2]))
        fitted: Any = GaussianProcessRegressor(kernel, n_restarts_optimizer=0).fit(X, y).kernel_
        theta = fitted.theta
        logs.append([*theta[1:-1], theta[0] / 2, theta[-1] / 2])  # theirs are logarithms of variances
    return np.array(logs)
