"""The paper's steady states in NumPy and SciPy, written independently of the package."""

import numpy as np
from scipy.optimize import brentq, root


def forces(c, V, beta, r, delta):
    """Axle forces of the car with parameters `c` (a `VehicleConfig`)."""
    front = np.arctan2(V * np.sin(beta) + c.a * r, V * np.cos(beta)) - delta
    rear = np.arctan2(V * np.sin(beta) - c.b * r, V * np.cos(beta))
    weight = c.m * 9.81 / (c.a + c.b)
    law = lambda alpha, Fz: -c.mu * Fz * np.sin(c.C * np.arctan(c.B * alpha))
    return law(front, weight * c.b), law(rear, weight * c.a)


def balance(c, V, beta, r, delta, Fxr):
    """Longitudinal, lateral and yaw balance in the car's frame, over the weight."""
    Ff, Fr = forces(c, V, beta, r, delta)
    x = Fxr - Ff * np.sin(delta) + c.m * V * r * np.sin(beta)
    y = Ff * np.cos(delta) + Fr - c.m * V * r * np.cos(beta)
    yaw = c.a * Ff * np.cos(delta) - c.b * Fr
    return np.array([x, y, yaw / (c.a + c.b)]) / (c.m * 9.81)


def _roots(f, cells=3000) -> list[float]:
    grid = np.linspace(-np.pi / 2, np.pi / 2, cells)
    values = np.array([f(g) for g in grid])
    cells_with_root = np.flatnonzero(values[1:] * values[:-1] < 0)
    return [brentq(f, grid[i], grid[i + 1], xtol=1e-14) for i in cells_with_root]  # pyright: ignore


def steady_states(c, V, r):
    """All (beta, delta, Fxr) at speed V and yaw rate r, by scanning two scalar equations."""
    share = c.m * V * r / (c.a + c.b)
    out = []
    for beta in _roots(lambda beta: forces(c, V, beta, r, 0.0)[1] - share * c.a * np.cos(beta)):
        front = lambda d, beta=beta: forces(c, V, beta, r, d)[0] * np.cos(d) - share * c.b * np.cos(beta)
        for delta in _roots(front):
            Ff = forces(c, V, beta, r, delta)[0]
            out.append((beta, delta, Ff * np.sin(delta) - c.m * V * r * np.sin(beta)))
    return out


def nearest(c, V, r, guess):
    """SciPy's root of the three balances from a guess (beta, delta, Fxr)."""
    unit = np.array([1.0, 1.0, c.m * 9.81])
    solution = root(lambda y: balance(c, V, y[0], r, *(y * unit)[1:]), np.asarray(guess) / unit, tol=1e-13)
    return solution.x * unit, np.max(np.abs(solution.fun)) < 1e-10
