"""Recordings of a car with hidden effects, and the small catalogue that all tests of the diagnosis share."""

import functools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from driftjax.diagnosis.fit import Problem, initial_problem, with_estimated_noise
from driftjax.diagnosis.noise_model import Noise
from driftjax.logs import Run
from driftjax.manoeuvres.campaign import is_lost, typical_conditions
from driftjax.manoeuvres.library import MANOEUVRES, RICH
from driftjax.sim.record import Conditions, Manoeuvre, record
from driftjax.vehicle import VehicleConfig, load_vehicle
from driftjax.vehicle.effect import Effect, effects_by_name
from driftjax.vehicle.universal import Universal, universal_car

NAMES = (
    "friction_rear stiffness_front load_transfer_long relaxation_length aero_drag drive_gain yaw_inertia steer_offset "
    "steer_lag gyro_bias"
).split()
EFFECTS = effects_by_name(tuple(NAMES))
ORDER = [effect.name for effect in EFFECTS]  # one parameter each
DT, ROWS = 0.01, 600
ACCELERATION = 0.05  # noise of ax, ay [m/s^2]


@functools.cache
def nominal_car(name: str) -> VehicleConfig:
    return replace(load_vehicle(name), combined_slip=1.0)


def sedan() -> VehicleConfig:
    return nominal_car("sedan")


@functools.cache
def catalogue(name: str = "sedan") -> Universal:
    return universal_car(nominal_car(name), EFFECTS)


@functools.cache
def truth(name: str = "sedan") -> Noise:
    """Noise of good sensors, and rates disturbed as a real car's are."""
    conditions = typical_conditions(nominal_car(name))
    return Noise.from_vector(np.hstack(conditions))


def hidden(**values: float) -> np.ndarray:
    """Parameters with these effects at these values, in typical sizes."""
    return np.array([values.get(name, 0.0) for name in ORDER])


@eqx.filter_jit
def _drive(model: Universal, name: str, theta, manoeuvres: Manoeuvre, conditions: Conditions, keys):
    plant, vehicle = model.with_parameters(theta), nominal_car(name)
    return jax.vmap(lambda m, key: record(plant, vehicle, m, conditions, key, DT))(manoeuvres, keys)


@functools.cache
def standard(seed: int, name: str = "sedan") -> Manoeuvre:
    """The standard manoeuvres, 6 s each, one after the other."""
    rng, t = np.random.default_rng(seed), np.arange(ROWS) * DT
    rows = [jax.tree.map(jnp.asarray, MANOEUVRES[one](nominal_car(name), rng, t)) for one in RICH]
    return jax.tree.map(lambda *a: jnp.stack(a), *rows)


def with_slow_errors(noise: Noise) -> Noise:
    """The `noise` with as large errors of its sensors that last for 0.3 s."""
    return noise._replace(slow=noise.sigma, slow_correlation=0.3)


def recorded(
    theta: np.ndarray, seed: int, noise_seed: int, disturbed: float = 1.0, car: str = "sedan", slow: bool = False
) -> tuple[Run, ...]:
    """The standard manoeuvres of `seed` on a car with the parameters `theta`; runs that spin are left out."""
    t, manoeuvres, vehicle = np.arange(ROWS) * DT, standard(seed, car), nominal_car(car)
    keys = jax.random.split(jax.random.key(noise_seed), len(RICH))
    noise = truth(car)._replace(disturbance=disturbed * truth(car).disturbance)
    conditions = Conditions(*map(jnp.asarray, with_slow_errors(noise) if slow else noise))
    records = jax.tree.map(np.asarray, _drive(catalogue(car), car, jnp.asarray(theta), manoeuvres, conditions, keys))
    runs = []
    for i, name in enumerate(RICH):
        one = jax.tree.map(lambda a: a[i], records)  # noqa: B023
        if not is_lost(vehicle, one):
            ax, ay = one.a.T + ACCELERATION * np.random.default_rng((noise_seed, i)).standard_normal((2, ROWS))
            extra = {"psi": one.place.psi, "s": one.place.s, "ax": ax, "ay": ay}
            (V, beta, r), (delta, Fxr) = one.y.T, one.command.T
            runs.append(Run(f"{name}{i}", t, V, beta, r, delta, Fxr, DT, extra))
    return tuple(runs)


def build_problem(
    vehicle: VehicleConfig, effects: tuple[Effect, ...], runs: tuple[Run, ...], without: tuple[str, ...] = ()
) -> Problem:
    """The problem of a diagnosis, with the noise estimated from `runs` as what no active effect explains."""
    problem = initial_problem(vehicle, effects, runs, without)
    return with_estimated_noise(problem, problem.start, problem.active)


@functools.cache
def problem_of(seed: int, noise_seed: int, **truth: float) -> Problem:
    """The problem of the sedan with the effects `truth`, in typical sizes, hidden in its recording."""
    return build_problem(sedan(), EFFECTS, recorded(hidden(**truth), seed, noise_seed))
