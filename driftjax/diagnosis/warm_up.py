"""Compile the programs that a diagnosis needs later in a thread, while its first steps compute.

Compiling takes longer than all else in the first diagnosis on a machine, and leaves a core idle: what one thread
compiles, the other finds ready.
"""

import jax
import jax.numpy as jnp
import numpy as np

from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import ROOM, predict_ahead, prediction_starts
from driftjax.diagnosis.noise_floor import STARTS, batched_rollouts
from driftjax.diagnosis.observer import observe_runs
from driftjax.diagnosis.runs import BATCH_SIZE, LANES, by_commands, padded_size, take
from driftjax.parallel import compile_ahead


def compile_programs(problem: Problem) -> None:
    """Compile observer, roll-outs, predictions and the derivatives by commands for the shapes of `problem`."""
    model, data, dt, theta = problem.model, problem.data, problem.data.dt, jnp.asarray(problem.start)
    lane, number = np.zeros(LANES, int), np.arange(BATCH_SIZE)
    many, observed = jnp.tile(theta, (LANES, 1)), (data.padded, problem.gains.L, problem.gains.decay)
    compile_ahead(observe_runs, model, many, *take(observed, lane), dt)
    runs = take(data.padded, np.zeros(BATCH_SIZE, int))
    num = jnp.asarray(prediction_starts(problem)[1])
    states, room = (BATCH_SIZE, data.size, 6), padded_size(int(num), ROOM)
    z, P, ahead = np.zeros(states), np.zeros((*states[:2], 9, 9)), np.zeros((BATCH_SIZE, STARTS, room, 3))
    first, noise = jnp.arange(STARTS), jnp.asarray(problem.noise.as_vector())
    compile_ahead(batched_rollouts, model, theta, runs, z, P, ahead, number, first, num, noise, dt, jnp.asarray(0))
    place = jax.tree.map(jnp.asarray, take(data.padded.place, (lane[:, None], np.zeros((LANES, room), int))))
    rows = jnp.zeros((LANES, 6)), jnp.zeros((LANES, room, 4))
    compile_ahead(predict_ahead, model, many, *rows, place, num, dt, None)
    compile_ahead(by_commands, model, theta, runs, dt)
