"""Extended Kalman filter: observer gains along its own estimates, for a sideslip that no sensor measures.

A measured sideslip holds the observer near the car, whatever its gains: they may belong to a path that an earlier
observer took. Without it, a car that drifts is unstable and is lost by gains of another path. The extended filter
linearises the car about its own estimate at every sample (Anderson and Moore 1979, Sec. 8.2).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import State
from driftjax.diagnosis.noise_model import Noise, decay_of, initial_covariance, process_covariance, transition
from driftjax.diagnosis.observer import (
    Gains,
    KalmanGain,
    ObserverEstimate,
    ObserverRow,
    ObserverUpdate,
    PaddedRun,
    kalman_gain,
    observe_sample,
    predicted_covariance,
    prepare_run,
)
from driftjax.sim.rollout import move
from driftjax.vehicle.universal import Universal


class _Filtered(NamedTuple):
    """What the filter holds after some samples."""

    now: ObserverEstimate
    P: Float[Array, "9 9"]  # covariance, before the next sample is read
    gains: KalmanGain  # of all samples (T, ...), zero where none was read
    cost: Array  # minus twice the log-likelihood so far


def filter_runs(
    model: Universal, theta: Float[Array, " K"], runs: PaddedRun, noise: Float[Array, "11"], dt: float,
    informative: Float[Array, "T 3"],
) -> tuple[Gains, Float[Array, " R"]]:  # fmt: skip
    """Return the gains of the extended Kalman filter of a batch of runs, and minus twice the log-likelihood of each.

    `noise` as `Noise.as_vector`; `informative` as for `kalman_gains`. It reads all runs to the end of the longest.
    """
    known = Noise.from_vector(noise)
    decay = decay_of(known, dt)
    num, T = runs.valid.shape[:2]
    _, rows, first = jax.vmap(lambda run: prepare_run(model, theta, run, jnp.zeros((T, 9, 3)), dt))(runs)
    Q, speed_counts = process_covariance(known, decay), jnp.max(informative[:, 0])

    def on(k: Array, filtered: _Filtered, row: ObserverRow) -> _Filtered:
        gain = kalman_gain(filtered.P, row.valid, known, informative[k], speed_counts)
        after, update = observe_sample(model, theta, decay, filtered.now, row._replace(L=gain.L), dt)
        F = transition(*_derivatives(model.with_parameters(theta), update, row, jnp.asarray(dt)), decay)
        cost = filtered.cost + row.alive * (jnp.sum((gain.whitening @ update.e) ** 2) + 2 * gain.log_det)
        gains = jax.tree.map(lambda all, new: all.at[k].set(new), filtered.gains, gain)
        return _Filtered(after, predicted_covariance(gain.P, F, Q, row.alive), gains, cost)

    def on_all(k: Array, filtered: _Filtered) -> _Filtered:
        return jax.vmap(on, (None, 0, 0))(k, filtered, jax.tree.map(lambda a: a[:, k], rows))

    zeros = lambda *shape: jnp.zeros((num, T, *shape))
    gains = KalmanGain(zeros(9, 3), zeros(3, 3), zeros(9, 9), zeros())
    P = jnp.broadcast_to(initial_covariance(known), (num, 9, 9))
    last = jnp.max(jnp.sum(rows.alive, axis=1))
    filtered = jax.lax.fori_loop(0, last, on_all, _Filtered(first, P, gains, jnp.zeros(num)))
    L, whitening, P, log_det = filtered.gains
    decays = jax.tree.map(lambda a: jnp.broadcast_to(a, (num, *jnp.shape(a))), decay)
    return Gains(L, whitening, decays, P, jnp.sum(log_det, axis=1)), filtered.cost


def _derivatives(model: Universal, update: ObserverUpdate, row: ObserverRow, dt: Array) -> tuple[Array, Array]:
    """Return the derivatives (3, 3) of the next state by the one after `update`, and by disturbances of the rates."""
    ahead = lambda x, d: move(model, jnp.concatenate([x, update.z[3:]]), row.u, row.place, dt, State(*d)).z[:3]
    return jax.jacfwd(ahead, (0, 1))(update.z[:3], update.d)
