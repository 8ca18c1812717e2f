"""The drift MPC (Wu et al. 2025, Eq. 10): track a reference with the nominal car plus its learnt residual."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import as_float, lag_step, require
from driftjax.vehicle import AnyCar, Residual, VehicleConfig, build_car
from driftjax.vehicle.single_track import G

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
    """SQP iterations allowed per solve."""

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


class DriftOCP(eqx.Module):
    """Data of Eq. 10, SI: a car with its residual, weights, limits; `drift_batch_ocp` has its equations.

    The residual rate is evaluated at the start of a step and constant over its Runge-Kutta stages, exactly as it is
    measured in `learning`; the GP is thus evaluated once a step, and model and data agree at any step length. Commands
    act through the learnt lags; with lags of 0, as in the paper, they act at once.
    """

    nominal: AnyCar
    residual: Residual
    horizon: int = eqx.field(static=True)
    dt: Array = eqx.field(converter=as_float)
    Q: Array  # (5,) weights
    R: Array  # (2,) weights
    front_slip: Array = eqx.field(converter=as_float)  # weight
    lower: Array  # (2,) smallest delta, Fxr
    upper: Array  # (2,)
    rate: Array  # (2,) largest change per step
    weight: Array = eqx.field(converter=as_float)  # of the car, the solver's unit of force [N]

    @property
    def car(self) -> AnyCar:
        """Return the nominal car with the parameters of the residual."""
        return self.residual.tuned(self.nominal)

    @property
    def u_scale(self) -> Array:
        """Return the solver's units (2,) of delta [rad] and Fxr [N]."""
        return jnp.stack([jnp.ones_like(self.weight), self.weight], axis=-1)


def drift_ocp(
    config: MPCConfig,
    weights: Weights,
    vehicle: VehicleConfig,
    residual: Residual,
    nominal: AnyCar | None = None,
) -> DriftOCP:
    """Build the problem of one car; `nominal` defaults to the car of `vehicle`, named effects included."""
    lower, upper, rate = vehicle.command_limits()
    return DriftOCP(
        nominal=build_car(vehicle) if nominal is None else nominal,
        residual=residual,
        horizon=config.horizon,
        dt=config.dt,
        Q=jnp.array(weights.Q + weights.Q_path),
        R=jnp.array([config.R[0], config.R[1] / config.Fxr_unit**2]),
        front_slip=weights.front_slip,
        lower=jnp.asarray(lower),
        upper=jnp.asarray(upper),
        rate=config.dt * jnp.asarray(rate),
        weight=vehicle.m * G,
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
