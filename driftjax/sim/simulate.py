"""Simulate a batch of cars open loop under a batch of commands, as a labelled dataset."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import Array
from numpy.typing import ArrayLike

from driftjax.core import BadInput, Control, require
from driftjax.environment import require_float64
from driftjax.parallel import call
from driftjax.sim.plant_files import batch_of
from driftjax.sim.universal_plant import AnyPlant
from driftjax.vehicle import Motion, PlantConfig, VehicleConfig

CHANNELS = {
    "V": ("m/s", "speed of the centre of mass"),
    "beta": ("rad", "sideslip, left positive"),
    "r": ("rad/s", "yaw rate, left positive"),
    "x": ("m", "position"),
    "y": ("m", "position"),
    "psi": ("rad", "heading, not wrapped"),
    "ax": ("m/s^2", "forward specific force"),
    "ay": ("m/s^2", "specific force to the left"),
    "delta": ("rad", "road-wheel angle reached, left positive"),
    "Fxr": ("N", "longitudinal force of the rear axle reached, driving positive"),
}


def simulate(
    cars: VehicleConfig | PlantConfig | Sequence[VehicleConfig | PlantConfig],
    commands: ArrayLike,
    dt: float,
    *,
    start: ArrayLike = (10.0, 0.0, 0.0),
    substeps: int = 10,
    lap: float = 1000.0,
) -> xr.Dataset:
    """Simulate a batch of cars under commands held over each sample; row k is the state before command k acts.

    `cars` are vehicles (single track with all their effects) or plants (double track), not both. `commands` (time, 2)
    or (car, time, 2) are delta [rad] and Fxr [N]; `start` (3,) or (car, 3) is V [m/s], beta [rad], r [rad/s]. A single
    car, command sequence or start is shared by a batch of the others. `dt` is the sample time [s], of `substeps`
    integration steps; `lap` [m] is the length of the road on which position-dependent effects repeat.

    Variables have the dimensions (car, time), units and names; a car whose state overflows is NaN from there on and
    does not affect the others. Raises `BadInput` for shapes that do not fit.
    """
    require_float64()
    require(dt > 0 and substeps >= 1, f"dt is {dt} and substeps is {substeps}; give a positive time and at least 1.")
    configs = [cars] if isinstance(cars, VehicleConfig | PlantConfig) else list(cars)
    if len({type(config) for config in configs}) > 1:
        raise BadInput("cars are vehicles and plants; simulate each kind by itself.")
    u, x = np.asarray(commands, float), np.asarray(start, float)
    require(u.ndim in (2, 3) and u.shape[-1] == 2, f"commands have shape {u.shape}; give (time, 2) or (car, time, 2).")
    require(x.ndim in (1, 2) and x.shape[-1] == 3, f"start has shape {x.shape}; give (3,) or (car, 3).")
    sizes = {len(configs), *(len(array) for array, ndim in ((u, 3), (x, 2)) if array.ndim == ndim)} - {1}
    require(len(sizes) <= 1, f"cars, commands and start have batches of {sorted(sizes)}; give one size, or 1.")
    num = max(sizes, default=1)
    u, x = np.broadcast_to(u, (num, *u.shape[-2:])), np.broadcast_to(x, (num, 3))
    configs = configs * num if len(configs) == 1 else configs
    plants = batch_of(configs, lap, dt / substeps)
    motion = call(roll_out, plants, jnp.asarray(u), jnp.asarray(x), dt, substeps)
    return _dataset(motion, u, dt, [config.name for config in configs])


def roll_out(plants: AnyPlant, commands: Array, start: Array, dt: float, substeps: int) -> Motion:
    """Drive every plant through its commands and return the motion before each of them."""

    def one(plant: AnyPlant, commands: Array, start: Array) -> Motion:
        def step(state, row):
            command = Control(row[0], row[1])
            return plant.advance(state, command, dt, substeps), plant.motion(state, command)

        return jax.lax.scan(step, plant.rolling(start[0], beta=start[1], r=start[2]), commands)[1]

    return jax.vmap(one)(plants, commands, start)


def _dataset(motion: Motion, commands: np.ndarray, dt: float, names: list[str]) -> xr.Dataset:
    dims = ("car", "time")
    values = {name: np.asarray(getattr(motion, name)) for name in CHANNELS}
    variables = {
        name: xr.Variable(dims, values[name], {"units": units, "long_name": words})
        for name, (units, words) in CHANNELS.items()
    }
    for column, (name, units) in enumerate((("delta", "rad"), ("Fxr", "N"))):
        attrs = {"units": units, "long_name": f"commanded {name}"}
        variables[f"{name}_command"] = xr.Variable(dims, commands[..., column], attrs)
    time = xr.Variable("time", np.arange(commands.shape[1]) * dt, {"units": "s", "long_name": "time"})
    return xr.Dataset(variables, {"car": names, "time": time})
