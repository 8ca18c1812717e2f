"""Estimate the state in closed loop: an extended Kalman filter on the learnt car that also bridges the delay."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State, as_float, features, lag_step, rk4_step
from driftjax.sim.lap import wrap
from driftjax.vehicle import AnyCar, Residual
from driftjax.vehicle.single_track import G

MODEL_ERROR = 0.05  # force that the model lacks at each axle, as a share of the weight; white over `MEMORY`
MEMORY = 0.3  # s


class Estimate(NamedTuple):
    """Estimate of the motion at a sample, before its measurement, and of the actuators."""

    x: Float[Array, "6"]  # V, beta, r, x, y, psi
    P: Float[Array, "6 6"]
    lagged_input: Float[Array, "2"]  # actuator outputs
    commands: Float[Array, "n 2"]  # not yet acting, the oldest first
    known: Array  # whether a measurement has been used


class Estimator(eqx.Module):
    """Extended Kalman filter of one car (Anderson and Moore 1979, Sec. 8.2), with a known delay of the commands."""

    noise: Float[Array, "6"]  # standard deviations of the measurements
    rate_noise: Float[Array, "6"]  # spectral density of the rate errors, root [unit/s^0.5]
    dt: Array = eqx.field(converter=as_float)
    whole: int = eqx.field(static=True)  # steps of delay
    part: Array | None  # of a further step, None without [s]

    @property
    def num_pending(self) -> int:
        """Return the number of commands that do not act yet at a sample."""
        return self.whole + (self.part is not None)

    def start(self) -> Estimate:
        """Return the estimate before the first sample: nothing is known, no command is pending."""
        commands = jnp.zeros((self.num_pending, 2))
        return Estimate(jnp.zeros(6), jnp.zeros((6, 6)), jnp.zeros(2), commands, jnp.asarray(False))

    def update(self, before: Estimate, y: Float[Array, "6"]) -> Estimate:
        """Return the estimate after the measurement `y`; the first one is taken as it is."""
        R = jnp.diag(self.noise**2)
        S = before.P + R
        L = jnp.linalg.solve(S, before.P).T
        innovation = y - before.x
        innovation = innovation.at[5].set(wrap(innovation[5]))
        rest = jnp.eye(6) - L
        P = rest @ before.P @ rest.T + L @ R @ L.T  # Joseph's form keeps it positive
        first = before._replace(x=y, P=R, known=jnp.asarray(True))
        later = before._replace(x=before.x + L @ innovation, P=P)
        return jax.tree.map(lambda a, b: jnp.where(before.known, a, b), later, first)

    def _move(
        self, car: AnyCar, residual: Residual, x: Array, lagged_input: Array, u: Array, time: Array
    ) -> tuple[Array, Array]:
        """Return motion and actuator outputs after `time` [s] of the command `u`."""
        acting, end = lag_step(lagged_input, u, residual.lags, time)
        mean = Control(acting[0], acting[1])
        d = residual(features(State(x[0], x[1], x[2]), mean))

        def rates(w: Array) -> Array:
            dx = car(State(w[0], w[1], w[2]), mean)
            course = w[5] + w[1]
            return jnp.stack([dx.V + d[0], dx.beta + d[1], dx.r + d[2], w[0] * jnp.cos(course), w[0] * jnp.sin(course),
                              w[2]])  # fmt: skip

        return rk4_step(rates, x, time), end

    def ahead(self, car: AnyCar, residual: Residual, now: Estimate) -> tuple[Float[Array, "6"], Float[Array, "2"]]:
        """Predict motion and actuator outputs at the time when the next command starts to act."""
        x, lagged_input = now.x, now.lagged_input
        for k in range(self.num_pending):
            time = self.part if self.part is not None and k == 0 else self.dt
            x, lagged_input = self._move(car, residual, x, lagged_input, now.commands[k], time)
        return x, lagged_input

    def predict(self, car: AnyCar, residual: Residual, now: Estimate, command: Float[Array, "2"]) -> Estimate:
        """Return the estimate before the next sample, once the `command` of this one is known."""
        queue = jnp.concatenate([now.commands, command[None]])

        def move(x: Array) -> tuple[Array, tuple[Array, Array]]:
            lagged_input, time = now.lagged_input, self.dt
            if self.part is not None:
                x, lagged_input = self._move(car, residual, x, lagged_input, queue[0], self.part)
                time = self.dt - self.part
            last = queue[0 if self.part is None else 1]
            x, lagged_input = self._move(car, residual, x, lagged_input, last, time)
            return x, (x, lagged_input)

        F, (x, lagged_input) = jax.jacfwd(move, has_aux=True)(now.x)
        P = F @ now.P @ F.T + self.dt * jnp.diag(self.rate_noise**2)
        return Estimate(x, (P + P.T) / 2, lagged_input, queue[1:], now.known)


def build_estimator(
    noise: Float[Array, "6"], delay: float, dt: float, V: float, weight: float, arm: float, Iz: float
) -> Estimator:
    """Build the filter for a car of `weight` [N], yaw inertia `Iz` [kg m^2] and lever `arm` [m] at speeds about `V`.

    `noise` holds the standard deviations of V, beta, r, x, y, psi; commands act `delay` [s] after their sample.
    """
    rates = MODEL_ERROR * jnp.array([G, G / V, weight * arm / Iz])
    density = jnp.concatenate([rates * jnp.sqrt(2 * MEMORY), jnp.zeros(3)])
    whole, part = divmod(round(delay / dt, 9), 1.0)
    return Estimator(noise, density, dt, int(whole), jnp.asarray(part * dt) if part else None)
