"""One step of many cars, as this package simulates them."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from driftjax.core import Control, State, rk4_step
from driftjax.vehicle import DoubleTrack, PlantState, SingleTrack, load_plant, load_vehicle
from experiments.bench.config import Dtype
from experiments.bench.drift import U_REF, U_SPREAD, X_REF, X_SPREAD

DT = (0.01, 0.05)  # steps of the single track [s]
PLANT_DT = 1e-3  # step of the double track [s], whose wheels are quick


def columns(num: int, dtype: Dtype) -> tuple[np.ndarray, ...]:
    """V, beta, r, delta, Fxr and step (num,) of cars about the reference drift."""
    rng = np.random.default_rng(0)
    x = X_REF + rng.uniform(-1, 1, (num, 3)) * X_SPREAD
    u = U_REF + rng.uniform(-1, 1, (num, 2)) * U_SPREAD
    table = np.concatenate([x, u, rng.uniform(*DT, (num, 1))], axis=1)
    return tuple(np.ascontiguousarray(column, dtype) for column in table.T)


@eqx.filter_jit
def _step(car: SingleTrack, x: State, u: Control, dt: jax.Array) -> State:
    return rk4_step(lambda y: car(y, u), x, dt)


@eqx.filter_jit
def _advance(plant: DoubleTrack, state: PlantState, command: Control) -> PlantState:
    return jax.vmap(lambda x, u: plant.advance(x, u, PLANT_DT, 1))(state, command)


def ours(dtype: Dtype, batch: int) -> Callable[[], State]:
    """One step of `batch` single-track cars, ready to be run."""
    double = dtype == "float64"

    def run() -> State:
        with jax.enable_x64(double):
            return _step(car, State(V, beta, r), Control(delta, Fxr), dt)

    with jax.enable_x64(double):
        car = load_vehicle("sedan").build()
        V, beta, r, delta, Fxr, dt = map(jnp.asarray, columns(batch, dtype))
    return run


def ours_plant(dtype: Dtype, batch: int) -> Callable[[], PlantState]:
    """One step of `batch` double-track cars, with all that they have and the nominal car lacks."""
    double = dtype == "float64"

    def run() -> PlantState:
        with jax.enable_x64(double):
            return _advance(plant, state, command)

    with jax.enable_x64(double):
        plant = load_plant("sedan").build()
        V, beta, r, delta, Fxr, _ = map(jnp.asarray, columns(batch, dtype))
        state = jax.vmap(plant.rolling)(V)
        state = state._replace(vx=V * jnp.cos(beta), vy=V * jnp.sin(beta), r=r, delta=delta, drive=Fxr)
        command = Control(delta, Fxr)
    return run
