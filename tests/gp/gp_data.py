"""Data that several GP tests share."""

import numpy as np


def smooth(N, nf=3, D=2, noise=0.05, seed=0):
    """Inputs of unlike units and smooth targets with noise."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1.5, 1.5, size=(N, nf))
    waves = [np.sin(2 * X[:, 0]) + 0.5 * X[:, 1], np.cos(X[:, 1] + X[:, 2]) * X[:, 0], X[:, 2] ** 2 - 0.5]
    Y = np.stack(waves[:D], axis=1) * np.array([2.0, 0.1, 30.0])[:D]
    Y = Y + noise * Y.std(axis=0) * rng.normal(size=Y.shape)
    return X * np.array([3.0, 0.2, 4e3])[:nf] + np.array([12.0, -0.4, 6e3])[:nf], Y
