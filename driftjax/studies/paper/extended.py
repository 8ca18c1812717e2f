"""Extend the nominal car by `diagnose`, from one log of the car that the plants are drawn around."""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import Control
from driftjax.diagnosis.diagnose import diagnose
from driftjax.diagnosis.held_out import DiagnoseConfig
from driftjax.logs import Log, Run, write_log
from driftjax.manoeuvres.campaign import REDRAWS, SPIN, typical_conditions
from driftjax.manoeuvres.library import MANOEUVRES, RICH, vehicle_units
from driftjax.parallel import call
from driftjax.sim.record import FILTER, Manoeuvre
from driftjax.store.files import write_json
from driftjax.vehicle import DoubleTrack, PlantState, VehicleConfig, load_plant, write_vehicle
from driftjax.vehicle.effect import EFFECTS

SECONDS, RATE, SETTLE = 10.0, 100.0, 1.0  # of a run, samples per second, driven before the first of them [s]
STEP = 5e-4  # of the plant [s]
JSON, CAR = "diagnosis.json", "extended.yaml"


def extend(car: str, vehicle: VehicleConfig, folder: Path, report: Callable[[str], None]) -> None:
    """Write log.csv, diagnosis.json and extended.yaml of the central car of `car`'s plants into `folder`."""
    runs = simulated_runs(load_plant(car).build(), vehicle, np.random.default_rng(0))
    folder.mkdir(parents=True, exist_ok=True)
    write_log(folder / "log.csv", runs)
    log = Log(runs, paths=(folder / "log.csv",))
    sensors = tuple(name for name, effect in EFFECTS.items() if effect.station == "sensor")  # these are known
    diagnosis = diagnose(vehicle, log, DiagnoseConfig(gp=False, without=sensors), report=report)
    write_json(folder / JSON, diagnosis.content())
    write_vehicle(folder / CAR, diagnosis.extended)


def simulated_runs(plant: DoubleTrack, vehicle: VehicleConfig, rng: np.random.Generator) -> tuple[Run, ...]:
    """Simulate one run of each manoeuvre of the standard campaign, redrawn where the car spins."""
    t = np.arange(round((SECONDS + SETTLE) * RATE)) / RATE
    return tuple(_run(f"{kind}-{i + 1}", kind, plant, vehicle, rng, t) for i, kind in enumerate(RICH))


def _run(
    name: str, kind: str, plant: DoubleTrack, vehicle: VehicleConfig, rng: np.random.Generator, t: np.ndarray
) -> Run:
    for _ in range(1 + REDRAWS):
        manoeuvre = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)), MANOEUVRES[kind](vehicle, rng, t))
        key = jax.random.key(rng.integers(2**32, dtype=np.uint32))
        y, command = map(
            np.asarray, call(follow, plant, vehicle, manoeuvre, typical_conditions(vehicle).sigma, key, 1 / RATE)
        )
        if np.isfinite(y).all() and np.abs(y[:, 1]).max() < SPIN:
            settled = t >= SETTLE
            (V, beta, r), (delta, Fxr) = y[settled].T, command[settled].T
            return Run(name, t[settled] - SETTLE, V, beta, r, delta, Fxr, 1 / RATE)
    raise RuntimeError(f"{vehicle.name}: it spun in {1 + REDRAWS} draws of '{kind}'")


def follow(
    plant: DoubleTrack, vehicle: VehicleConfig, manoeuvre: Manoeuvre, sigma: Float[Array, "3"], key: Array, dt: float
) -> tuple[Float[Array, "T 3"], Float[Array, "T 2"]]:
    """Return measured V, beta, r with noise `sigma`, and the commands [rad, N] of a driver who filters them."""
    lower, upper, rate = vehicle.command_limits()
    smooth = 1 - jnp.exp(-dt / (FILTER * vehicle_units(vehicle).time))
    first, u0 = manoeuvre.x_ref[0], jnp.clip(manoeuvre.u_ref[0], lower, upper)

    def step(now: tuple[PlantState, Array, Array], row: tuple[Array, Array, Array]):
        state, filtered, command = now
        x_ref, u_ref, noise = row
        motion = plant.motion(state, Control(command[0], command[1]))
        y = jnp.stack([motion.V, motion.beta, motion.r]) + noise
        filtered = filtered + smooth * (y - filtered)
        command = jnp.clip(u_ref - manoeuvre.K @ (filtered - x_ref), command - dt * rate, command + dt * rate)
        command = jnp.clip(command, lower, upper)
        state = plant.advance(state, Control(command[0], command[1]), dt, round(dt / STEP))
        return (state, filtered, command), (y, command)

    noise = sigma * jax.random.normal(key, manoeuvre.x_ref.shape)
    # free-rolling wheels; tyres and loads converge within `SETTLE`
    rolling = plant.rolling(first[0], beta=first[1], r=first[2])._replace(delta=u0[0], drive=u0[1])
    start = (rolling, first, u0)
    return jax.lax.scan(step, start, (manoeuvre.x_ref, manoeuvre.u_ref, noise))[1]
