"""Recordings of a sedan with hidden effects, and the small catalogue that all tests of the diagnosis share."""

import functools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from driftjax.control.manoeuvre import MANOEUVRES, RICH, size
from driftjax.data import Run
from driftjax.diagnose.noise import Noise
from driftjax.sim.record import Conditions, Manoeuvre, record
from driftjax.vehicle import VehicleConfig, load_vehicle
from driftjax.vehicle.effect import effects_named
from driftjax.vehicle.single_track import G
from driftjax.vehicle.universal import Universal, universal

NAMES = (
    "friction_rear stiffness_front load_transfer_long relaxation_length aero_drag drive_gain yaw_inertia steer_offset "
    "steer_lag gyro_bias"
).split()
EFFECTS = effects_named(tuple(NAMES))
ORDER = [effect.name for effect in EFFECTS]  # one parameter each
DT, ROWS = 0.01, 600
ACCELERATION = 0.05  # noise of ax, ay [m/s^2]


@functools.cache
def sedan() -> VehicleConfig:
    return replace(load_vehicle("sedan"), combined_slip=1.0)


@functools.cache
def catalogue() -> Universal:
    return universal(sedan(), EFFECTS)


@functools.cache
def truth() -> Noise:
    """Noise of good sensors, and rates disturbed as a real car's are."""
    unit = size(sedan())
    disturbance = np.array([0.0092 * G, 0.0084 / unit.time, 0.028 / unit.time**2])
    return Noise(np.array([0.05, 0.0087, 0.0087]), disturbance, 0.3)


def hidden(**found: float) -> np.ndarray:
    """Parameters with these effects at these values, in typical sizes."""
    return np.array([found.get(name, 0.0) for name in ORDER])


@eqx.filter_jit
def _drive(model: Universal, theta, manoeuvres: Manoeuvre, conditions: Conditions, keys):
    plant = eqx.tree_at(lambda m: m.theta, model, theta)
    return jax.vmap(lambda m, key: record(plant, sedan(), m, conditions, key, DT))(manoeuvres, keys)


@functools.cache
def standard(seed: int) -> Manoeuvre:
    """The standard manoeuvres, 6 s each, one after the other."""
    rng, t = np.random.default_rng(seed), np.arange(ROWS) * DT
    rows = [jax.tree.map(jnp.asarray, MANOEUVRES[name](sedan(), rng, t)) for name in RICH]
    return jax.tree.map(lambda *a: jnp.stack(a), *rows)


def recorded(theta: np.ndarray, seed: int, noise_seed: int) -> tuple[Run, ...]:
    """The standard manoeuvres of `seed` on a sedan with the parameters `theta`; runs that spin are left out."""
    t, manoeuvres = np.arange(ROWS) * DT, standard(seed)
    keys = jax.random.split(jax.random.key(noise_seed), len(RICH))
    conditions = Conditions(*map(jnp.asarray, truth()))
    found = jax.tree.map(np.asarray, _drive(catalogue(), jnp.asarray(theta), manoeuvres, conditions, keys))
    runs = []
    for i, name in enumerate(RICH):
        V, beta = found.x[i, :, 0], found.x[i, :, 1]
        if np.isfinite(found.y[i]).all() and abs(beta).max() < 1.2 and V.min() > 0.3 * size(sedan()).speed:
            ax, ay = found.a[i].T + ACCELERATION * np.random.default_rng((noise_seed, i)).standard_normal((2, ROWS))
            extra = {"psi": found.place.psi[i], "s": found.place.s[i], "ax": ax, "ay": ay}
            (V, beta, r), (delta, Fxr) = found.y[i].T, found.command[i].T
            runs.append(Run(f"{name}{i}", t, V, beta, r, delta, Fxr, DT, extra))
    return tuple(runs)
