"""Drive a controller of your own in closed loop, on three cars: it steers along the centre line and holds the speed."""

import jax
import jax.numpy as jnp

import driftjax as dj
from driftjax.sim import LapCode, LapConfig, batch_of, drive
from driftjax.sim.sensors import load_sensors

track, num = dj.load_track("sedan_corner"), 3
plants = batch_of(dj.draw_plants("sedan", num, seed=1), float(track.length), step=0.001)  # double-track cars
paths = jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * num), track)


def policy(sensed, memory, alive):
    """Map measurements (num,) to commands; `memory` is what the controller carries from step to step, here nothing."""
    kappa = jax.vmap(lambda path, s: path.pose(s)[3])(paths, sensed.s + 1.0)  # of the path 1 m ahead
    steering = 3.0 * kappa - 0.1 * sensed.e - 0.8 * sensed.theta
    return dj.Control(steering, 4000.0 * (9.0 - sensed.V)), memory, ()


keys, speeds = jax.random.split(jax.random.key(0), num), jnp.full(num, 9.0)
laps = drive(plants, paths, speeds, policy, (), load_sensors("sedan"), LapConfig(20.0, substeps=20), dt=0.05, keys=keys)
print([LapCode(int(code)).name for code in laps.code], "mean offset [m]:", jnp.abs(laps.trace.e).mean(axis=1))
