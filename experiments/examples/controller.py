"""Drive a controller of your own in closed loop, on three cars: it steers along the centre line and holds the speed."""

import jax
import jax.numpy as jnp

import driftjax as dj

track, plants = dj.load_track("sedan_corner"), dj.draw_plants("sedan", 3, seed=1)  # double-track cars


def policy(sensed, memory, alive):
    """Map measurements (3,) to commands; `memory` is what the controller carries from step to step, here nothing."""
    kappa = jax.vmap(lambda s: track.pose(s)[3])(sensed.s + 1.0)  # of the path 1 m ahead
    steering = 3.0 * kappa - 0.1 * sensed.e - 0.8 * sensed.theta
    return dj.Control(steering, 4000.0 * (9.0 - sensed.V)), memory, ()


laps = dj.drive_laps(plants, track, policy, V=9.0, config=dj.LapConfig(20.0, substeps=20))
print([dj.LapCode(int(code)).name for code in laps.code], "mean offset [m]:", jnp.abs(laps.trace.e).mean(axis=1))
