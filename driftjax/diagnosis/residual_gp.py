"""A GP on what a model leaves unexplained: the rival of a named cause, and its complement."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import Control, State, features
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import ahead
from driftjax.diagnosis.runs import each_piece, follow, held
from driftjax.gp import GP, fit, select_dictionary

WINDOW = 0.2  # time over which a residual rate is measured: shorter drowns in noise, longer blurs [s]
SIZE = 300  # rows that the GP is conditioned on


def residual_rates(task: Problem, theta: np.ndarray) -> tuple[Array, Array, Array]:
    """Where the model `theta` was (n, 5) as `features`, the mean rates (n, 3) that it lacks there, which rows count.

    States come from an observer of fixed gain, which believes the data more than any model; a rate is the change
    that the model misses over one window, over its length.
    """
    data, num = task.data, round(WINDOW / task.data.dt)
    starts = np.arange(num, data.size - num, num)
    path = follow(task.model, data, theta, held(data))
    one = lambda run, z: ahead(task.model, jnp.asarray(theta), run, z, jnp.asarray(starts), num, data.dt, None)
    found = each_piece(one, len(data.run), data.track, path.z)[:, :, -1]
    lacking = (path.z[:, starts + num, :3] - found) / WINDOW
    middle = starts + num // 2
    x, u = path.z[:, middle, :3], path.u[:, middle]
    Z = jax.vmap(jax.vmap(lambda x, u: features(State(*x), Control(u[0], u[1]))))(x, u)
    measured = np.asarray(path.seen)[:, starts + num].all(axis=-1)
    return Z.reshape(-1, 5), lacking.reshape(-1, 3), jnp.asarray(measured.reshape(-1))


def learnt(task: Problem, theta: np.ndarray, seed: int) -> GP:
    """The GP on what the model `theta` lacks in these data, outputs in SI rates."""
    kept = select_dictionary(*residual_rates(task, theta), SIZE)
    return fit(*kept, key=jax.random.key(seed)).gp
