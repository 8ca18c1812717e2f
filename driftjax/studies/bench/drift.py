"""Reference drift: the sedan's problem of Eq. 10 around one steady drift, with 256 initial states."""

import dataclasses
from functools import cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.control.mpc import MPCConfig, Weights
from driftjax.core import Control, State
from driftjax.vehicle import VehicleConfig, load_vehicle

X_REF, U_REF = np.array([9.0, -0.54507, 1.1]), np.array([-0.29676, 6849.25])  # V, beta, r; delta, Fxr
X_SPREAD, U_SPREAD = np.array([1.0, 0.15, 0.25]), np.array([0.08, 1000.0])
FRICTION = 0.95  # of the car that differs from the nominal one, over the nominal's
SPREAD = 0.3  # share of these by which starts differ from the drift, uniformly to either side
HORIZON = 20
WEIGHTS = Weights(Q=(1.0, 700.0, 500.0))
TOLERANCE = 1e-6


class Starts(NamedTuple):
    """Initial states and last commands of solves."""

    x: np.ndarray  # (n, 3) V, beta, r
    previous: np.ndarray  # (n, 2) last command delta [rad], Fxr [N]


@cache
def car() -> VehicleConfig:
    """Return the sedan with the limits of the reference problem."""
    limits = {"delta_max": 0.6, "Fxr_min": 0.0, "Fxr_max": 1e4, "delta_rate_max": 2.0, "Fxr_rate_max": 3e4}
    return dataclasses.replace(load_vehicle("sedan"), **limits)


def config(horizon: int = HORIZON) -> MPCConfig:
    """Return the MPC options: step of 0.05 s; R of 10 on rad^2 and 1e-3 on kN^2, changes per step."""
    return MPCConfig(horizon=horizon, dt=0.05, R=(10.0, 0.001), Fxr_unit=1000.0, tolerance=TOLERANCE, max_steps=60)


def starts(num: int = 256, spread: float = SPREAD) -> Starts:
    """Return `num` states and last commands around the drift; up to 256, the first ones do not depend on `num`."""
    rng, num_drawn = np.random.default_rng(0), max(num, 256)
    x = X_REF + spread * rng.uniform(-1, 1, (num_drawn, 3)) * X_SPREAD
    previous = U_REF + spread * rng.uniform(-1, 1, (num_drawn, 2)) * U_SPREAD
    return Starts(x[:num], previous[:num])


def residual_rows(num: int) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs (num, 5) around the drift, and the rate differences (num, 3) of a car with less friction."""
    rng = np.random.default_rng(1)
    x = X_REF + rng.uniform(-1, 1, (num, 3)) * X_SPREAD
    u = U_REF + rng.uniform(-1, 1, (num, 2)) * U_SPREAD
    nominal = car().build()
    other = eqx.tree_at(lambda c: c.tyre.mu, nominal, FRICTION * nominal.tyre.mu)

    def difference(x: Array, u: Array) -> Array:
        rates = lambda c: jnp.stack(c(State(*x), Control(*u)))
        return rates(other) - rates(nominal)

    return np.concatenate([x, u], axis=1), np.asarray(jax.vmap(difference)(jnp.asarray(x), jnp.asarray(u)))
