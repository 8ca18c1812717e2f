"""The drift MPC of the paper for batches: the three states it tracks, the nominal car, a batch on the last axis."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from driftjax.control.mpc import MPCConfig, Reference, Weights
from driftjax.core import Control, State, require, rk4_step
from driftjax.solve.lane_ocp import AbstractLanes, Components, Limits
from driftjax.solve.sparse import Matrix, runge_kutta, runge_kutta_curvature
from driftjax.vehicle import AnyCar, VehicleConfig, build_car


class DriftLanes(AbstractLanes):
    """Eq. 10 (Wu et al. 2025): state (V, beta, r) in SI, inputs delta [rad] and Fxr in `Fxr_unit` newtons.

    Path and actuators are not in it: the paper's weights on the path are zero and its commands act at once. `params`
    of the solver are the rows V, beta, r of a `Reference`.
    """

    car: AnyCar
    dt: Array
    Q: Sequence[Array]  # weights on V, beta, r
    R: Sequence[Array]  # weights on the changes of delta and of Fxr in its unit
    lower: Sequence[Array]  # smallest delta and Fxr
    upper: Sequence[Array]
    rate: Sequence[Array]  # largest change per step
    Fxr_unit: float = eqx.field(static=True, default=1000.0)

    def _rates(self, V: Array, beta: Array, r: Array, delta: Array, Fxr: Array) -> State:
        return self.car(State(V, beta, r), Control(delta, self.Fxr_unit * Fxr))

    def step(self, x: Components, u: Components, p: Components) -> Components:
        """Next state by one RK4 step."""
        return list(rk4_step(lambda x: self._rates(*x, *u), State(*x), self.dt))

    def linearise(self, x: Components, u: Components, p: Components) -> tuple[Components, Matrix]:
        """Next state and its derivatives, chained over the stages of the RK4 step."""
        return runge_kutta(self._rates, x, u, self.dt)

    def curvature(self, x: Components, u: Components, costate: Components, p: Components) -> Matrix:
        """Exact second derivatives of the RK4 step."""
        return runge_kutta_curvature(self._rates, x, u, self.dt, costate)

    def cost(self, x: Components, u: Components, p: Components) -> Array:
        """Tracking of this state."""
        return self.terminal(x, p)

    def terminal(self, x: Components, p: Components) -> Array:
        """Tracking of this state."""
        V, beta, r = (q * (a - b) ** 2 for q, a, b in zip(self.Q, x, p, strict=True))
        return V + beta + r

    def rate_weight(self) -> Sequence[Array]:
        """Weights of the changes of the inputs."""
        return self.R

    def input_limits(self) -> Limits:
        """Of delta and Fxr."""
        return list(zip(self.lower, self.upper, strict=True))

    def change_limits(self) -> Limits:
        """Of their changes per step."""
        return [(-rate, rate) for rate in self.rate]


def drift_lanes(config: MPCConfig, weights: Weights, vehicle: VehicleConfig, dtype: type = float) -> DriftLanes:
    """The problem of one car in one precision; weights on path and front slip must be the paper's zeros."""
    require(weights.Q_path == (0.0, 0.0) and weights.front_slip == 0.0, "batched solves have no weights on the path.")
    unit = config.Fxr_unit
    pair = lambda delta, Fxr: [jnp.asarray(value, dtype) for value in (delta, Fxr / unit)]
    lower, upper, rate = vehicle.command_limits()
    car = jax.tree.map(lambda leaf: leaf.astype(dtype), build_car(vehicle))
    return DriftLanes(
        car=car,
        dt=jnp.asarray(config.dt, dtype),
        Q=[jnp.asarray(q, dtype) for q in weights.Q],
        R=[jnp.asarray(r, dtype) for r in config.R],
        lower=pair(*lower),
        upper=pair(*upper),
        rate=pair(*(config.dt * r for r in rate)),
        Fxr_unit=unit,
    )


def tracked(reference: Reference) -> Components:
    """What `DriftLanes` tracks of a reference, as parameters of the solver."""
    return [jnp.asarray(leaf) for leaf in (reference.V, reference.beta, reference.r)]
