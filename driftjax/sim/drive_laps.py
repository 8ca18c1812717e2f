"""Drive laps with the user's own controller."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from driftjax.core import require
from driftjax.environment import require_float64
from driftjax.sim.lap import LapConfig, Laps, Policy, drive
from driftjax.sim.plant_files import batch_of
from driftjax.sim.sensors import load_sensors
from driftjax.track import Track
from driftjax.vehicle import PlantConfig, VehicleConfig


def drive_laps(
    cars: Sequence[PlantConfig] | Sequence[VehicleConfig],
    track: Track,
    policy: Policy,
    V: ArrayLike,
    *,
    memory: Any = (),
    sensors: str | Path = "sedan",
    config: LapConfig | None = None,
    dt: float = 0.05,
    seed: int = 0,
) -> Laps:
    """Drive one lap of `track` with each of `cars` in closed loop, commanded by `policy` every `dt` [s].

    `policy(sensed, memory, alive)` is traced by JAX and serves all n cars at once: `sensed` are measurements with
    fields (n,), `memory` is what it returned at the step before, `alive` (n,) says which laps still run. It returns a
    `Control` with fields (n,), new memory and a record of the step, for `laps.trace.decision`. Its first `memory` has a
    leading axis n. The lap starts straight at the speed `V` [m/s], () or (n,). `cars` are plants (double track) or
    vehicles (single track with effects), not both; `sensors` is a shipped set (`sedan`, `rc`) or a YAML; `seed` is
    that of their noise, which differs between the cars. Raises `BadInput` for cars of both kinds.

    Fields of `laps.trace` are (n, steps), valid where `laps.trace.alive`; `laps.code` (n,) are numbers of `LapCode`.
    """
    require_float64()
    config = LapConfig() if config is None else config
    num = len(cars)
    require(len({type(car) for car in cars}) == 1, "cars are vehicles and plants, or none; give one kind.")
    paths = jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * num), track)
    plants = batch_of(cars, float(track.length), dt / config.substeps)
    speeds, keys = jnp.broadcast_to(jnp.asarray(V, float), (num,)), jax.random.split(jax.random.key(seed), num)
    return drive(plants, paths, speeds, policy, memory, load_sensors(sensors), config, dt=dt, keys=keys)
