"""Step of the single track compiled by numba: a loop over cars on one core."""

from collections.abc import Callable
from math import atan, atan2, cos, sin

import numba
import numpy as np

from driftjax.vehicle import VehicleConfig

G = 9.81


@numba.njit(fastmath=True)
def _rates(car, V, beta, r, delta, Fxr):
    m, Iz, a, b, front, rear, B, C = car
    vx, vy = V * cos(beta), V * sin(beta)
    Fyf = -front * sin(C * atan(B * (atan2(vy + a * r, vx) - delta)))
    Fyr = -rear * sin(C * atan(B * atan2(vy - b * r, vx)))
    return (
        (-Fyf * sin(delta - beta) + Fyr * sin(beta) + Fxr * cos(beta)) / m,
        (Fyf * cos(delta - beta) + Fyr * cos(beta) - Fxr * sin(beta)) / (m * V) - r,
        (a * Fyf * cos(delta) - b * Fyr) / Iz,
    )


@numba.njit(fastmath=True)
def _loop(car, two, six, V, beta, r, delta, Fxr, dt, V_end, beta_end, r_end):
    # `two` and `six` come in the precision of the arrays: a literal would make all of it double
    for i in range(V.size):
        x, y, z, d, F, h = V[i], beta[i], r[i], delta[i], Fxr[i], dt[i]
        half, sixth = h / two, h / six
        a1, b1, c1 = _rates(car, x, y, z, d, F)
        a2, b2, c2 = _rates(car, x + half * a1, y + half * b1, z + half * c1, d, F)
        a3, b3, c3 = _rates(car, x + half * a2, y + half * b2, z + half * c2, d, F)
        a4, b4, c4 = _rates(car, x + h * a3, y + h * b3, z + h * c3, d, F)
        V_end[i] = x + sixth * (a1 + two * (a2 + a3) + a4)
        beta_end[i] = y + sixth * (b1 + two * (b2 + b3) + b4)
        r_end[i] = z + sixth * (c1 + two * (c2 + c3) + c4)


def numba_steps(v: VehicleConfig, columns: tuple[np.ndarray, ...]) -> Callable[[], tuple[np.ndarray, ...]]:
    """Return a function that gives V, beta, r (n,) one step after V, beta, r, delta, Fxr, dt (n,), of one precision."""
    dtype = columns[0].dtype.type
    end = tuple(np.empty(len(columns[0]), dtype) for _ in range(3))
    grip = v.mu * v.m * G / (v.a + v.b)
    car = tuple(map(dtype, (v.m, v.Iz, v.a, v.b, grip * v.b, grip * v.a, v.B, v.C)))

    def run() -> tuple[np.ndarray, ...]:
        _loop(car, dtype(2), dtype(6), *columns, *end)
        return end

    return run
