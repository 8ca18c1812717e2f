"""Noise floor of predictions: errors of the right model, from disturbed roll-outs of the same car with sensor noise.

Each drive starts where the car may have been when the prediction was made, and its rates are disturbed at random.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import State
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import ROOM, Predictions, scan_rows
from driftjax.diagnosis.noise_model import Noise, decay_of, stationary_deviations
from driftjax.diagnosis.observer import PaddedRun, command_response, set_state
from driftjax.diagnosis.runs import batches, map_pieces, padded_size
from driftjax.parallel import call
from driftjax.sim.rollout import move, sensor_reading
from driftjax.vehicle.universal import Universal

STARTS = 20  # starts of roll-outs in one call
DRAWS = 16  # drives from each start
ROUNDING = 1e-9  # added to correlations, so that they have a root


def covariance_root(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return a matrix root of the covariance `M`, which maps white noise to noise of covariance `M`."""
    size = jnp.sqrt(jnp.diagonal(M))
    unit = jnp.where(size > 0, size, 1.0)
    return size[:, None] * jnp.linalg.cholesky(M / (unit[:, None] * unit) + ROUNDING * jnp.eye(len(M)))


def disturbed_rollouts(
    model: Universal, theta: Array, run: PaddedRun, z: Float[Array, "T 6"], P: Float[Array, "T 9 9"],
    ahead: Float[Array, "S N 3"], number: Array, starts: Float[Array, " S"], num: Array, noise: Float[Array, "11"],
    dt: float, seed: Array,
) -> Float[Array, "S N 3"]:  # fmt: skip
    """Return the mean squared difference between sensor readings of disturbed roll-outs and the predictions `ahead`.

    Drives of `num` steps start at samples `starts` about the states `z` with the covariances `P`; predictions know no
    disturbance.
    """
    model, step = model.with_parameters(theta), jnp.asarray(dt)
    u = command_response(model, run, dt)[-len(run.y) :]
    known = Noise.from_vector(noise)
    decay, size = decay_of(known, dt).all, stationary_deviations(known)
    kick = jnp.sqrt(1 - decay**2) * size

    def drive(k, ahead, key):
        first, later = jax.random.split(key)
        w = covariance_root(P[k].at[3:, 3:].set(jnp.diag(size**2))) @ jax.random.normal(first, (9,))
        start = set_state(model, z[k], z[k, :3] + w[:3], u[k])

        kicks = jax.random.normal(later, (len(ahead), 6))

        def on(j, carry):
            z, slow = carry
            at = jnp.minimum(k + j, len(run.y) - 1)
            after = move(model, z, u[at], jax.tree.map(lambda a: a[at], run.place), step, State(*slow[:3]))
            slow = decay * slow + kick * kicks[j]
            off = sensor_reading(model, after.z[:3], after.rates, step) + slow[3:] - ahead[j]
            return (after.z, slow), off.at[1].set(jnp.angle(jnp.exp(1j * off[1]))) ** 2

        return scan_rows(on, (start, w[3:]), num, len(ahead))

    key = jax.random.fold_in(jax.random.key(seed), number)
    keys = jax.vmap(lambda k: jax.random.split(jax.random.fold_in(key, k), DRAWS), out_axes=1)(starts)
    # draws one after the other: all at once, the program takes twice as long to compile, and to run
    squares = jax.lax.map(lambda keys: jax.vmap(drive)(starts, ahead, keys), keys)
    return squares.mean(axis=0) + known.sigma**2


def batched_rollouts(model, theta, runs, z, P, ahead, number, starts, num, noise, dt, seed):
    """Return `disturbed_rollouts` (pieces, S, N, 3) of a batch of pieces.

    `runs`, `z`, `P`, `ahead` and `number` have the leading axis of the pieces; all else is shared.
    """
    axes = (None, None, 0, 0, 0, 0, 0, None, None, None, None, None)
    return eqx.filter_vmap(disturbed_rollouts, in_axes=axes)(
        model, theta, runs, z, P, ahead, number, starts, num, noise, dt, seed
    )


def noise_floor(
    problem: Problem, theta: np.ndarray, ahead: Predictions, seed: int, *, disturbed: bool = True
) -> np.ndarray:
    """Return the mean squared errors (P, S, N, 3) expected of the predictions `ahead` if the car `theta` is right.

    NaN where nothing was measured to compare with, as in the padding of a run. Unless the car is `disturbed`, they are
    those of its sensors alone: the estimated disturbances also hold what a wrong car gets wrong.
    """
    data, where, num = problem.data, jnp.asarray(theta), ahead.readings.shape[2]
    share = np.repeat([1.0, float(disturbed), 1.0], 3)  # of the state, disturbances and slow errors
    known = problem.noise._replace(disturbance=share[3:6] * problem.noise.disturbance)
    noise, number = jnp.asarray(known.as_vector()), np.arange(len(data.run))
    P = np.asarray(problem.gains.P) * np.outer(share, share)
    readings = np.pad(ahead.readings, ((0, 0), (0, 0), (0, padded_size(num, ROOM) - num), (0, 0)))

    def some(first: Array) -> np.ndarray:
        there = readings[:, np.searchsorted(ahead.starts, first)]
        of = lambda *rows: call(
            batched_rollouts, problem.model, where, *rows, first, jnp.asarray(num), noise, data.dt, jnp.asarray(seed)
        )
        return map_pieces(of, len(data.run), data.padded, ahead.z, P, there, number)

    return np.where(np.isfinite(ahead.error), _map_starts(some, ahead.starts)[:, :, :num], np.nan)


def _map_starts(function: Callable[[Array], np.ndarray], starts: np.ndarray) -> np.ndarray:
    """Apply `function` to `STARTS` starts at a time; return its values (P, S, ...) for all."""
    parts = [function(jnp.asarray(starts[batch])) for batch in batches(len(starts), STARTS)]
    return np.concatenate(parts, axis=1)[:, : len(starts)]
