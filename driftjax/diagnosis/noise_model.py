"""Noise of a log: white and slow errors of the sensors, and slowly varying disturbances of the car's rates.

Around its path the car is linear in w = (state, disturbances of its rates, slow errors of its sensors), which this
module gives the transition, covariance and measurement matrices of. Disturbances and slow errors are stationary
first-order Markov processes (Ljung 1999, Sec. 4.3; Bryson and Johansen 1965 for coloured measurement noise).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

START_VARIANCE = 4.0  # variance of the first state, over that of one measurement


class Noise(NamedTuple):
    """Standard deviations and correlation times of all noise."""

    sigma: np.ndarray  # (3,) standard deviation of the white errors of V, beta, r
    disturbance: np.ndarray  # (3,) standard deviation of the rates of V, beta, r
    correlation: float  # correlation time of the disturbances [s]
    slow: np.ndarray  # (3,) standard deviation of the slow errors of V, beta, r
    slow_correlation: float  # and their correlation time [s]

    @property
    def total(self) -> np.ndarray:
        """Return the standard deviation (3,) of all errors of V, beta, r."""
        return np.hypot(self.sigma, self.slow)

    def as_vector(self) -> np.ndarray:
        """Return all parameters as one vector (11,)."""
        return np.concatenate([self.sigma, self.disturbance, [self.correlation], self.slow, [self.slow_correlation]])

    @classmethod
    def from_vector(cls, values: Any) -> "Noise":
        """Return the noise with the parameters of `as_vector`."""
        return cls(values[:3], values[3:6], values[6], values[7:10], values[10])


class Decay(NamedTuple):
    """Factors over one step."""

    disturbance: Array
    slow: Array

    @property
    def all(self) -> Float[Array, "6"]:
        """Return the factor of every disturbance and slow error."""
        return jnp.concatenate([jnp.full(3, self.disturbance), jnp.full(3, self.slow)])


def decay_of(noise: Noise, dt: float) -> Decay:
    """Return the factors of disturbances and slow errors over one step `dt` [s]."""
    return Decay(jnp.exp(-dt / noise.correlation), jnp.exp(-dt / noise.slow_correlation))


def stationary_deviations(noise: Noise) -> Float[Array, "6"]:
    """Return the standard deviations of disturbances and slow errors."""
    return jnp.concatenate([jnp.asarray(noise.disturbance), jnp.asarray(noise.slow)])


def transition(A: Float[Array, "3 3"], push: Float[Array, "3 3"], decay: Decay) -> Float[Array, "9 9"]:
    """Return the transition matrix of w over one step.

    `A` and `push` are the derivatives of the state by that one step before, and by the disturbances during the step.
    """
    return jnp.zeros((9, 9)).at[:3, :3].set(A).at[:3, 3:6].set(push).at[3:, 3:].set(jnp.diag(decay.all))


def process_covariance(noise: Noise, decay: Decay) -> Float[Array, "9 9"]:
    """Return the covariance that one step adds to w; disturbances and slow errors stay stationary."""
    return jnp.zeros((9, 9)).at[3:, 3:].set(jnp.diag((1 - decay.all**2) * stationary_deviations(noise) ** 2))


def initial_covariance(noise: Noise) -> Float[Array, "9 9"]:
    """Return the covariance of w at the first sample, whose state is the measured one with its sensor errors."""
    slow = jnp.diag(jnp.asarray(noise.slow) ** 2)
    state = START_VARIANCE * jnp.diag(jnp.asarray(noise.sigma) ** 2) + slow
    P = jnp.zeros((9, 9)).at[:3, :3].set(state).at[3:, 3:].set(jnp.diag(stationary_deviations(noise) ** 2))
    return P.at[:3, 6:].set(-slow).at[6:, :3].set(-slow)


def measurement_matrix(D: Float[Array, "3 3"], valid: Float[Array, "3"]) -> Float[Array, "3 9"]:
    """Return the derivatives of the readings by w, for those `D` by the state; zero where nothing was measured."""
    return valid[:, None] * jnp.concatenate([D, jnp.zeros((3, 3)), jnp.eye(3)], axis=1)
