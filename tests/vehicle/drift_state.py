"""Steady drift of the plant at given sideslip and radius, by SciPy: for tests and for checking the reach of a plant."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import root

from driftjax.core import Control
from driftjax.vehicle import DoubleTrack, PlantState
from driftjax.vehicle.single_track import G


def _state(car: DoubleTrack, z, beta, R):
    """State with relaxed tyres from z = (V, delta, drive/1000 m, wheel speeds over V/radius (4), pitch, roll)."""
    V, R = z[0], jnp.asarray(R)
    vx, vy, r = V * jnp.cos(beta), V * jnp.sin(beta), V / R
    omega = z[3:7] * V / car.wheels.radius
    zero = jnp.zeros_like(V)
    drive = z[2] * car.chassis.m * G
    state = PlantState(zero, zero, zero, vx, vy, r, z[1], drive, z[7], z[8], omega, zero * omega, zero * omega)
    rest = car.forces(state)  # at zero slip the slip rates are the sliding velocities over the relaxation lengths
    sliding = rest.kappa_rate * car.wheels.relaxation_long, rest.alpha_rate * car.wheels.relaxation
    speed = jnp.hypot(omega * car.wheels.radius - sliding[0], sliding[1])
    return state._replace(kappa=sliding[0] / speed, alpha=sliding[1] / speed)


@eqx.filter_jit
def _residual(car, z, beta, R):
    state = _state(car, z, beta, R)
    dx = car.rates(state, Control(state.delta, state.drive))
    return jnp.concatenate(
        [jnp.stack([dx.vx, dx.vy, dx.r * R]), dx.omega * car.wheels.radius, jnp.stack([dx.pitch, dx.roll])]
    )


@eqx.filter_jit
def _jacobian(car, z, beta, R):
    return jax.jacfwd(_residual, argnums=1)(car, z, beta, R)


def drift_state(car: DoubleTrack, beta: float, R: float) -> tuple[PlantState, float]:
    """State of the steady drift and the largest rate left in it [m/s^2]; tries several guesses, keeps the best."""
    mu = float(car.tyre.mu.mean())
    best = None
    for delta in (-0.1, -0.25, -0.4, 0.05):
        for drive in (0.35, 0.25, 0.5):
            for spin in (1.0, 1.4):
                V = np.sqrt(0.93 * mu * G * R)
                z = np.array([V, delta, drive, 0.9, 1.0, spin, spin + 0.05, 3.0, 8.0 * mu])
                solution = root(lambda z: np.asarray(_residual(car, z, beta, R)), z,
                             jac=lambda z: np.asarray(_jacobian(car, z, beta, R)), method="hybr")  # fmt: skip
                left = float(np.abs(solution.fun).max())
                if solution.x[0] > 0 and abs(solution.x[1]) < 1.2 and (best is None or left < best[1]):
                    best = solution.x, left
                    if left < 1e-8:
                        return _state(car, jnp.asarray(solution.x), beta, R), left
    assert best is not None
    return _state(car, jnp.asarray(best[0]), beta, R), best[1]
