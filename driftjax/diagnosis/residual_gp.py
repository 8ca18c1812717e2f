"""Fit a GP to the rates that a model lacks: an alternative or a complement to named causes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import Control, State, features
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import predict_path
from driftjax.diagnosis.runs import fixed_gain, run_observer
from driftjax.gp import GP, fit_masked, select_dictionary

WINDOW = 0.2  # time over which a residual rate is measured: shorter drowns in noise, longer blurs [s]
DICTIONARY_SIZE = 300  # rows that the GP is conditioned on


def residual_rates(problem: Problem, theta: np.ndarray) -> tuple[Array, Array, Array]:
    """Return the states and inputs (n, 5) as `features`, mean rates (n, 3) that the model lacks, and which rows count.

    States come from an observer of fixed gain, which believes the data more than any model (where no sideslip is
    measured, from that of `problem`); a rate [SI] is the change of the state that the model `theta` misses over one
    window, over its length. Sensor effects take no part: the GP is added to the rates of the state, not to what sensors
    read.
    """
    data, num = problem.data, max(round(WINDOW / problem.data.dt), 1)
    starts = np.arange(max(num, data.skip), data.size - num, num)
    path = run_observer(problem.model, data, theta, problem.gains if data.skip else fixed_gain(data))
    predicted = predict_path(problem, theta, path, starts, num)[:, :, -1, 0]
    missed = np.array(path.z[:, starts + num, :3] - predicted)
    missed[..., 1] = np.angle(np.exp(1j * missed[..., 1]))  # the car may spin round
    lacking = missed / (num * data.dt)  # a window is a whole number of steps, not WINDOW
    middle = starts + num // 2
    x, u = path.z[:, middle, :3], path.u[:, middle]
    columns = lambda a: np.moveaxis(np.asarray(a), -1, 0)
    Z = jax.jit(features)(State(*columns(x)), Control(*columns(u)[:2]))
    valid = np.asarray(path.valid) > 0
    measured = (valid | ~valid.any(axis=(0, 1)))[:, starts + num].all(axis=-1)
    return Z.reshape(-1, 5), jnp.asarray(lacking.reshape(-1, 3)), jnp.asarray(measured.reshape(-1))


def fit_residual_gp(problem: Problem, theta: np.ndarray, seed: int) -> GP:
    """Fit a GP to the rates [SI] that the model `theta` lacks in these data."""
    kept = eqx.filter_jit(select_dictionary)(*residual_rates(problem, theta), DICTIONARY_SIZE)
    return fit_masked(*kept, key=jax.random.key(seed)).gp
