"""The minimum-time problem over arc length, written for the stage-wise solver."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from driftjax.core import Control, State, as_float, rk4_loop
from driftjax.solve import AbstractOCP
from driftjax.track import curvilinear_rates
from driftjax.vehicle import AnyCar, beyond_peak

SLOWEST = 0.1  # progress s_dot is held above this share of the speed scale, to survive wild trial steps


ENERGY_WEIGHT = 0.1  # of kinetic energy, in times at V_fair per energy at V_fair, so that excess speed is not kept
SHARPNESS = 16.0  # of the maximum that takes the reward from speeds above V_fair


class Stage(NamedTuple):
    """Constraints of the track and the drift device at one node; rows for all nodes."""

    kappa: Array  # curvature at the node, half a step on, and a step on (3,) [1/m]
    e_min: Array  # corridor of the centre of mass [m]
    e_max: Array
    side: Array  # +1 left-hand corner, -1 right-hand
    slip: Array  # -side beta must be at least this; far negative where the device is off [rad]
    beta_max: Array  # largest sideslip, either side [rad]
    share: Array  # of the step in the time integral: 1, but 1/2 at both ends (trapezoidal rule)


class PlanBounds(NamedTuple):
    """Bounds, in SI."""

    V_min: Array
    V_max: Array
    delta_max: Array
    delta_rate_max: Array
    Fxr_min: Array
    Fxr_max: Array
    Fxr_rate_max: Array
    end_slip: Array


class MinimumTime(AbstractOCP):
    """Minimum time through a corridor (Wu et al. 2025, Eq. 8), with bounded and slightly penalised input rates.

    State (V/V0, beta, r L0/V0, e/e0, theta, delta, Fxr/F0), input (delta_dot, Fxr_dot) relative to their limits;
    independent variable s, one classical Runge-Kutta step of `ds` per stage, the time by the trapezoidal rule in units
    of L0/V0.
    """

    model: Callable[[State, Control], State]
    limits: PlanBounds
    ds: Array = eqx.field(converter=as_float)  # step [m]
    V0: Array = eqx.field(converter=as_float)  # scale of the speed [m/s]
    L0: Array = eqx.field(converter=as_float)  # scale of length: smallest radius [m]
    e0: Array = eqx.field(converter=as_float)  # scale of the lateral offset [m]
    rate_weight: Array = eqx.field(converter=as_float)  # [-]
    course_weight: Array = eqx.field(converter=as_float)  # [-]
    front_slip: Array = eqx.field(converter=as_float)  # weight of front slip beyond the peak [-]
    nominal: AnyCar  # whose front slip angle is penalised
    V_fair: Array = eqx.field(converter=as_float)  # progress that hardly earns more time [m/s]

    @property
    def scale(self) -> Array:
        """Return the SI value of one unit of each state."""
        one = jnp.ones_like(self.V0)
        r0, F0 = self.V0 / self.L0, self.limits.Fxr_max
        return jnp.stack([self.V0, one, r0, self.e0, one, one, F0])

    def slope(self, x: Array, u: Array, kappa: Array) -> Array:
        """Return dx/ds in scaled states [1/m]."""
        V, beta, r, e, theta, delta, Fxr = x * self.scale
        dx = self.model(State(V, beta, r), Control(delta, Fxr))
        s_dot, e_dot, theta_dot = curvilinear_rates(V, beta, r, e, theta, kappa)
        rates = (u[0] * self.limits.delta_rate_max, u[1] * self.limits.Fxr_rate_max)
        return jnp.stack([*dx, e_dot, theta_dot, *rates]) / self.scale / self.progress(s_dot)

    def progress(self, s_dot: Array) -> Array:
        """Return s_dot [m/s], bounded below by a value that no feasible trajectory reaches."""
        return jnp.maximum(s_dot, SLOWEST * self.V0)

    def slowness(self, x: Array, kappa: Array) -> Array:
        """Return dt/ds [s/m]."""
        V, beta, r, e, theta, _, _ = x * self.scale
        return 1 / self.progress(curvilinear_rates(V, beta, r, e, theta, kappa)[0])

    def step(self, x: Array, u: Array, p: Stage) -> Array:
        """Return the state one step of `ds` further."""
        return rk4_loop(lambda x, kappa: self.slope(x, u, kappa), x, self.ds, p.kappa[jnp.array([0, 1, 1, 2])])

    def cost(self, x: Array, u: Array, p: Stage) -> Array:
        """Return the time of the stage and the costs of its rates and its course, in units of L0/V0."""
        return self.terminal(x, p) + self.rate_weight * self.ds / self.L0 * (u[0] ** 2 + u[1] ** 2)

    def terminal(self, x: Array, p: Stage) -> Array:
        """Return the time, and the costs of course and front slip, of this node by the trapezoidal rule."""
        slowness = self.slowness(x, p.kappa[0]) * self.V0
        floor = self.V0 / self.V_fair  # a smooth maximum of the two
        time = (slowness**SHARPNESS + floor**SHARPNESS) ** (1 / SHARPNESS)
        time = time + ENERGY_WEIGHT * floor * (x[0] * floor) ** 2
        V, beta, r, _, _, delta, Fxr = x * self.scale
        beyond = beyond_peak(self.nominal, State(V, beta, r), Control(delta, Fxr))
        penalty = self.course_weight * (x[1] + x[4]) ** 2 + self.front_slip * beyond**2
        return p.share * self.ds / self.L0 * (time + penalty)

    def constraints(self, x: Array, u: Array, p: Stage) -> Array:
        """Return the gaps of a stage, in scaled units."""
        return jnp.concatenate([self.bounds(x, p), 1 - u, 1 + u])

    def terminal_constraints(self, x: Array, p: Stage) -> Array:
        """Return the gaps of the last state, which must also be a normal one: small sideslip, along the track."""
        slip, course, end = x[1], x[1] + x[4], self.limits.end_slip
        return jnp.concatenate([self.bounds(x, p), jnp.stack([end - slip, end + slip, end - course, end + course])])

    def bounds(self, x: Array, p: Stage) -> Array:
        """Return the gaps of the state bounds."""
        V, beta, _, e, theta, delta, F = x
        lim = self.limits
        course = beta + theta  # |course| < 1.2 keeps s_dot well above zero
        return jnp.stack([
            V - lim.V_min / self.V0, lim.V_max / self.V0 - V,
            p.beta_max - beta, p.beta_max + beta, 1.2 - course, 1.2 + course,
            (p.e_max / self.e0 - e), (e - p.e_min / self.e0),
            lim.delta_max - delta, lim.delta_max + delta,
            lim.Fxr_max / lim.Fxr_max - F, F - lim.Fxr_min / lim.Fxr_max,
            -p.side * beta - p.slip,
        ])  # fmt: skip
