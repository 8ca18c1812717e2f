"""Step many cars by this package."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import Control, State, rk4_step
from driftjax.parallel import BatchExecutor, call
from driftjax.studies.bench.config import Dtype
from driftjax.studies.bench.drift import U_REF, U_SPREAD, X_REF, X_SPREAD
from driftjax.vehicle import DoubleTrack, PlantState, SingleTrack, load_plant, load_vehicle

DT = (0.01, 0.05)  # steps of the single track [s]
PLANT_DT = 1e-3  # step of the double track [s], whose wheels are quick


def columns(num: int, dtype: Dtype) -> tuple[np.ndarray, ...]:
    """Return V, beta, r, delta, Fxr and step (num,) of cars around the reference drift."""
    rng = np.random.default_rng(0)
    x = X_REF + rng.uniform(-1, 1, (num, 3)) * X_SPREAD
    u = U_REF + rng.uniform(-1, 1, (num, 2)) * U_SPREAD
    table = np.concatenate([x, u, rng.uniform(*DT, (num, 1))], axis=1)
    return tuple(np.ascontiguousarray(column, dtype) for column in table.T)


def step(batch: tuple[State, Control, Array], car: SingleTrack) -> State:
    """Return single-track cars one step later."""
    x, u, dt = batch
    return rk4_step(lambda y: car(y, u), x, dt)


def plant_step(batch: tuple[PlantState, Control], plant: DoubleTrack) -> PlantState:
    """Return double-track cars one step later."""
    return jax.vmap(lambda x, u: plant.advance(x, u, PLANT_DT, 1))(*batch)


def single_track_steps(dtype: Dtype, batch: int) -> Callable[[], State]:
    """Return one step of `batch` single-track cars in one call, which XLA splits over its threads, ready to run."""
    V, beta, r, delta, Fxr, dt = map(jnp.asarray, columns(batch, dtype))
    car = jax.tree.map(lambda leaf: leaf.astype(dtype), load_vehicle("sedan").build())
    inputs = (State(V, beta, r), Control(delta, Fxr), dt)
    return lambda: call(step, inputs, car)


def double_track_steps(dtype: Dtype, batch: int, executor: BatchExecutor | None = None) -> Callable[[], PlantState]:
    """Return one step of `batch` double-track cars on `executor` (in one call where None), ready to run.

    XLA does not split a program of that length over its own threads.
    """
    executor = BatchExecutor(None) if executor is None else executor
    V, beta, r, delta, Fxr, _ = map(jnp.asarray, columns(batch, dtype))
    plant = jax.tree.map(lambda leaf: leaf.astype(dtype), load_plant("sedan").build())
    state = jax.vmap(plant.rolling)(V)
    state = state._replace(vx=V * jnp.cos(beta), vy=V * jnp.sin(beta), r=r, delta=delta, drive=Fxr)
    state = jax.tree.map(lambda leaf: leaf.astype(dtype), state)
    return lambda: executor.map(plant_step, (state, Control(delta, Fxr)), plant)
