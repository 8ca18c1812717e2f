"""The drift MPC (Wu et al. 2025, Eq. 10): track a reference with the nominal car plus its learnt residual."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.control.residual import ResidualExpansion, expand_residual
from driftjax.core import Control, State, as_float, features, lag_step, require, rk4_loop, rk4_step
from driftjax.solve import AbstractOCP, Linear, Options, Solution, solve
from driftjax.track import curvilinear_rates
from driftjax.vehicle import AnyCar, Residual, VehicleConfig, beyond_peak, build_car

INTERIOR = 1e-3  # distance of a guess from a limit, as a share of its range, so that the barrier is finite


@dataclass(frozen=True)
class MPCConfig:
    """Horizon, weight on control effort and accuracy of the drift MPC; the paper leaves horizon and step open."""

    horizon: int = 30
    """Number of prediction steps N."""
    dt: float = 0.05
    """Step of prediction and control [s]."""
    R: tuple[float, float] = (10.0, 0.001)
    """Weights on the change per step of delta [rad] and of Fxr [Fxr_unit]."""
    Fxr_unit: float = 1000.0
    """Newtons in the unit of force that R is written for: 1000 for the sedan, 1 for the RC car."""
    tolerance: float = 1e-4
    """Scaled KKT residual at which a solve counts as converged."""
    max_steps: int = 30
    """Interior-point iterations allowed per solve."""

    def __post_init__(self) -> None:
        require(self.horizon >= 1, f"key 'horizon' is {self.horizon}; it must be at least 1.")
        require(self.dt > 0, f"key 'dt' is {self.dt}; it must be a positive time in seconds.")
        require(min(self.R) > 0, f"key 'R' is {self.R}; both weights must be positive.")
        require(self.Fxr_unit > 0, f"key 'Fxr_unit' is {self.Fxr_unit}; give newtons per unit, 1000 for kN.")
        require(self.tolerance > 0, f"key 'tolerance' is {self.tolerance}; it must be positive.")
        require(self.max_steps >= 1, f"key 'max_steps' is {self.max_steps}; it must be at least 1.")


@dataclass(frozen=True)
class Weights:
    """Weights on the tracking errors, which differ between controllers. The defaults are the paper's for the sedan."""

    Q: tuple[float, float, float] = (1.0, 700.0, 500.0)
    """Weights on V [m/s], beta [rad] and r [rad/s]."""
    Q_path: tuple[float, float] = (0.0, 0.0)
    """Weights on the lateral error e [m] and the heading error theta [rad]; zeros for the paper's controller."""
    front_slip: float = 0.0
    """Weight on the front slip angle beyond the tyre's peak [rad]: keeps the MPC off the drift with saturated front,
    from which it cannot steer; 0 for the paper's controller."""

    def __post_init__(self) -> None:
        held = (*self.Q, *self.Q_path, self.front_slip)
        require(min(held) >= 0, f"keys 'Q', 'Q_path' and 'front_slip' hold {held}; none may be negative.")


class Reference(eqx.Module):
    """Reference over one horizon: x_1..x_N are compared with rows 1..N."""

    V: Float[Array, " N+1"]  # speed [m/s]
    beta: Float[Array, " N+1"]  # sideslip [rad]
    r: Float[Array, " N+1"]  # yaw rate [rad/s]
    e: Float[Array, " N+1"]  # offset from the path, left positive [m]
    theta: Float[Array, " N+1"]  # heading of the car less that of the path [rad]
    kappa: Float[Array, " N+1"]  # curvature of the path where the car is expected [1/m]

    def states(self) -> Float[Array, "... 5"]:
        """Return the reference states (V, beta, r, e, theta); also of a single stage."""
        return jnp.stack([self.V, self.beta, self.r, self.e, self.theta], axis=-1)


class DriftOCP(AbstractOCP):
    """Eq. 10 with the state (V, beta, r, e, theta, last command (2), actuator outputs (2)), each over its scale.

    The residual rate is evaluated at the start of a step and constant over its Runge-Kutta stages, exactly as it is
    measured in `learning`; the GP is thus evaluated once a step, and model and data agree at any step length. Commands
    act through the learnt lags; with lags of 0, as in the paper, they act at once.
    """

    nominal: AnyCar
    residual: Residual
    horizon: int = eqx.field(static=True)
    dt: Array = eqx.field(converter=as_float)
    x_scale: Array  # (9,)
    Q: Array  # (5,) weights in SI
    R: Array  # (2,) weights in SI
    front_slip: Array = eqx.field(converter=as_float)  # weight in SI
    lower: Array  # (2,) smallest delta, Fxr
    upper: Array  # (2,)
    rate: Array  # (2,) largest change per step

    @property
    def u_scale(self) -> Array:
        """Return the scales (2,) of delta [rad] and Fxr [N]."""
        return self.x_scale[5:7]

    def _acting(self, x: Array, u: Array) -> Array:
        """Return the mean input over the step (2,), scaled: the lag response to the command."""
        return lag_step(x[7:], u, self.residual.lags, self.dt)[0]

    def _motion(self, v: Array, p: Reference, expansion: ResidualExpansion | None = None) -> Array:
        """Return (V, beta, r, e, theta) one step later from these and the mean input, `v` (7,); all scaled.

        With the residual's local `expansion` about this point it is cheap to differentiate, and exact to second order.
        """
        y, acting = v[:5] * self.x_scale[:5], Control(*(v[5:] * self.u_scale))
        z = features(State(y[0], y[1], y[2]), acting)
        d = self.residual(z) if expansion is None else expansion.at(z)

        def rates(w: Array, _: Any = None) -> Array:
            dx = self.nominal(State(w[0], w[1], w[2]), acting)
            _, e_dot, theta_dot = curvilinear_rates(w[0], w[1], w[2], w[3], w[4], p.kappa)
            return jnp.stack([dx.V + d[0], dx.beta + d[1], dx.r + d[2], e_dot, theta_dot])

        return (rk4_step if expansion is None else rk4_loop)(rates, y, self.dt) / self.x_scale[:5]

    def step(self, x: Array, u: Array, p: Reference) -> Array:
        """Return the next state by one RK4 step of nominal car, residual and curvilinear frame."""
        acting, end = lag_step(x[7:], u, self.residual.lags, self.dt)
        return jnp.concatenate([self._motion(jnp.concatenate([x[:5], acting]), p), u, end])

    def _selection(self) -> tuple[Array, Array]:
        """Return derivatives by (x, u): of `_motion`'s arguments (7, 11), of command and actuator outputs (4, 11)."""
        mean, left = (jnp.diag(share) for share in lag_step(jnp.ones(2), jnp.zeros(2), self.residual.lags, self.dt))
        one, none = jnp.eye(2), jnp.zeros((2, 2))
        path = jnp.concatenate([jnp.eye(5), jnp.zeros((5, 6))], axis=1)
        wide = jnp.zeros((2, 5))
        acting, last, lagged_input = (
            jnp.concatenate([wide, none, *blocks], axis=1)
            for blocks in ((mean, one - mean), (none, one), (left, one - left))
        )
        return jnp.concatenate([path, acting]), jnp.concatenate([last, lagged_input])

    def local_expansion(self, X: Array, U: Array, p: Reference) -> ResidualExpansion:
        """Expand the residual to second order at all stages."""
        acting = jax.vmap(self._acting)(X, U) * self.u_scale
        return expand_residual(self.residual, jnp.concatenate([X[:, :3] * self.x_scale[:3], acting], axis=1))

    def linearise(self, x: Array, u: Array, p: Reference, expansion: ResidualExpansion) -> Linear:
        """Return `step` and its derivatives (9, 9), (9, 2); only seven of its eleven columns need the car."""
        acting, end = lag_step(x[7:], u, self.residual.lags, self.dt)
        taken, linear = self._selection()
        motion = lambda v: (lambda y: (y, y))(self._motion(v, p, expansion))
        J, y = jax.jacfwd(motion, has_aux=True)(jnp.concatenate([x[:5], acting]))
        both = jnp.concatenate([J @ taken, linear])
        return Linear(jnp.concatenate([y, u, end]), both[:, :9], both[:, 9:])

    def curvature(self, x: Array, u: Array, costate: Array, p: Reference, expansion: ResidualExpansion) -> Array:
        """Return the second derivative (11, 11) of `costate @ step`; convergence needs the residual's part."""
        v = jnp.concatenate([x[:5], self._acting(x, u)])
        taken, _ = self._selection()
        return taken.T @ jax.hessian(lambda v: costate[:5] @ self._motion(v, p, expansion))(v) @ taken

    def _tracking(self, x: Array, p: Reference) -> Array:
        error = x[:5] * self.x_scale[:5] - p.states()
        return jnp.sum(self.Q * error**2)

    def cost(self, x: Array, u: Array, p: Reference) -> Array:
        """Return the cost of tracking this state, of the input change, and of front slip beyond the peak."""
        change = (u - x[5:7]) * self.u_scale
        y = x[:3] * self.x_scale[:3]
        acting = Control(*(self._acting(x, u) * self.u_scale))
        beyond = beyond_peak(self.nominal, State(y[0], y[1], y[2]), acting)
        return self._tracking(x, p) + jnp.sum(self.R * change**2) + self.front_slip * beyond**2

    def terminal(self, x: Array, p: Reference) -> Array:
        """Return the tracking cost of the last state."""
        return self._tracking(x, p)

    def constraints(self, x: Array, u: Array, p: Reference) -> Array:
        """Return the gaps of input and rate limits, over their scales."""
        scale = self.u_scale
        change = u - x[5:7]
        return jnp.concatenate(
            [
                u - self.lower / scale,
                self.upper / scale - u,
                self.rate / scale + change,
                self.rate / scale - change,
            ]
        )


def drift_ocp(
    config: MPCConfig,
    weights: Weights,
    vehicle: VehicleConfig,
    residual: Residual,
    nominal: AnyCar | None = None,
) -> DriftOCP:
    """Build the problem of one car; `nominal` defaults to the car of `vehicle`, named effects included."""
    weight = vehicle.m * 9.81
    speed = (9.81 * (vehicle.a + vehicle.b) * 5) ** 0.5  # drifting speed of a turn five wheelbases wide
    length = vehicle.a + vehicle.b
    lower, upper, rate = vehicle.command_limits()
    x_scale = jnp.array([speed, 1.0, speed / 5 / length, length, 1.0, 1.0, weight, 1.0, weight])
    return DriftOCP(
        nominal=build_car(vehicle) if nominal is None else nominal,
        residual=residual,
        horizon=config.horizon,
        dt=config.dt,
        x_scale=x_scale,
        Q=jnp.array(weights.Q + weights.Q_path),
        R=jnp.array([config.R[0], config.R[1] / config.Fxr_unit**2]),
        front_slip=weights.front_slip,
        lower=jnp.asarray(lower),
        upper=jnp.asarray(upper),
        rate=config.dt * jnp.asarray(rate),
    )


def within_limits(ocp: DriftOCP, U: Float[Array, "N 2"], previous: Float[Array, " 2"], share: float = INTERIOR):
    """Project inputs [rad, N] into rate limits (first) and input limits, shrunk by `share` of each limit's range."""
    margin = share * (ocp.upper - ocp.lower)

    def limit(last, u):
        u = jnp.clip(u, last - (1 - share) * ocp.rate, last + (1 - share) * ocp.rate)
        u = jnp.clip(u, ocp.lower + margin, ocp.upper - margin)
        return u, u

    return jax.lax.scan(limit, jnp.clip(previous, ocp.lower, ocp.upper), U)[1]


def along(ocp: DriftOCP, lagged_input: Float[Array, " 2"], U: Float[Array, "N 2"]) -> Float[Array, "N+1 2"]:
    """Return the actuator outputs at each stage [rad, N]."""

    def move(y, u):
        end = lag_step(y, u, ocp.residual.lags, ocp.dt)[1]
        return end, end

    return jnp.concatenate([lagged_input[None], jax.lax.scan(move, lagged_input, U)[1]])


class MPCSolution(eqx.Module):
    """Solution in SI units: the command to apply, the plan behind it, and its convergence."""

    u: Control  # first input of the plan
    X: Float[Array, "N+1 5"]  # predicted V, beta, r, e, theta
    U: Float[Array, "N 2"]  # planned delta, Fxr
    plan: Solution  # scaled solution with its residuals


def solve_mpc(
    ocp: DriftOCP,
    x: Float[Array, " 5"],
    previous: Float[Array, " 2"],
    lagged_input: Float[Array, " 2"],
    reference: Reference,
    X: Float[Array, "N+1 5"],
    U: Float[Array, "N 2"],
    options: Options,
) -> MPCSolution:
    """Solve Eq. 10 from `x` (V, beta, r, e, theta), command `previous`, actuator outputs and guess `X`, `U`, all SI."""
    U = within_limits(ocp, U, previous)
    before = jnp.concatenate([previous[None], U])
    guess = jnp.concatenate([X, before, along(ocp, lagged_input, U)], axis=1) / ocp.x_scale
    start = jnp.concatenate([x, previous, lagged_input]) / ocp.x_scale
    plan = solve(ocp, start, reference, guess, U / ocp.u_scale, options)
    # the interior point ends a rounding error inside the limits; clipping only takes that rounding away
    inputs = within_limits(ocp, plan.U * ocp.u_scale, previous, share=0.0)
    return MPCSolution(Control(inputs[0, 0], inputs[0, 1]), plan.X[:, :5] * ocp.x_scale[:5], inputs, plan)
