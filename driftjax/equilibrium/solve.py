"""Solve for steady states of any car model by Levenberg-Marquardt, with implicit gradients."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax import Array

from driftjax.core import RESULTS, Control, State, as_float
from driftjax.equilibrium.branch import classify
from driftjax.equilibrium.decoupled import Roots, decoupled_roots, drift_roots, pick
from driftjax.vehicle import AnyCar, SingleTrack
from driftjax.vehicle.single_track import G

Model = Callable[[State, Control], State]
TOLERANCE = 1e-9  # largest scaled residual of a solution
ANY = -1  # `branch` that accepts any


class Equilibrium(eqx.Module):
    """A steady state and its quality measures; without `result == successful` the values are the last iterate."""

    x: State
    u: Control
    residual: Array  # largest of V_dot / (mu g), beta_dot V / (mu g), r_dot Iz (a + b) / (mu m g a b) [-]
    kind: Array  # `Branch` by the slip angles of the car that judges it
    num_steps: Array
    eta: Array  # share of the learnt residual reached by a continuation, 1 for a direct solve [-]
    result: RESULTS


class SpeedYaw(eqx.Module):
    """Fixed speed and yaw rate (Wu et al. 2025, Sec. III-D); 0 to 3 values of beta are solutions."""

    V: Array = eqx.field(converter=as_float)  # [m/s]
    r: Array = eqx.field(converter=as_float)  # [rad/s]

    def point(self, free: Array) -> State:
        """Return the state with unknown `free` [-]."""
        return State(self.V, free, self.r)

    def free(self, x: State) -> Array:
        """Return the unknown of the state, scaled."""
        return x.beta

    def roots(self, nominal: SingleTrack) -> Roots:
        """Find every steady state of the nominal car."""
        return decoupled_roots(nominal, self.V, self.r)


class SlipRadius(eqx.Module):
    """Fixed sideslip and radius, r = V / R: well posed where fixing V and r is not."""

    beta: Array = eqx.field(converter=as_float)  # [rad]
    R: Array = eqx.field(converter=as_float)  # [m], positive to the left

    def point(self, free: Array) -> State:
        """Return the state with unknown `free` [-], the speed over sqrt(g R)."""
        V = free * jnp.sqrt(G * jnp.abs(self.R))
        return State(V, self.beta, V / self.R)

    def free(self, x: State) -> Array:
        """Return the unknown of the state, scaled."""
        return x.V / jnp.sqrt(G * jnp.abs(self.R))

    def roots(self, nominal: SingleTrack) -> Roots:
        """Find every steady state of the nominal car."""
        return drift_roots(nominal, self.beta, self.R)


class SlipSpeed(eqx.Module):
    """Fixed sideslip and speed; the yaw rate follows."""

    beta: Array = eqx.field(converter=as_float)  # [rad]
    V: Array = eqx.field(converter=as_float)  # [m/s]

    def point(self, free: Array) -> State:
        """Return the state with unknown `free` [-], V r / g."""
        return State(self.V, self.beta, free * G / self.V)

    def free(self, x: State) -> Array:
        """Return the unknown of the state, scaled."""
        return x.r * self.V / G


Fixed = SpeedYaw | SlipRadius | SlipSpeed


def scaled_rates(nominal: AnyCar, x: State, dx: State) -> Array:
    """Return the rates (3,) relative to the tyres' capability, so that one tolerance suits all cars."""
    limit = nominal.tyre.mu * G
    wheelbase = nominal.a + nominal.b
    yaw = nominal.Iz * wheelbase / (nominal.m * limit * nominal.a * nominal.b)
    return jnp.stack([dx.V / limit, dx.beta * x.V / limit, dx.r * yaw])


def solve_equilibrium(
    model: Model,
    nominal: AnyCar,
    fixed: Fixed,
    guess: tuple[State, Control],
    *,
    branch: Array | int = ANY,
    throw: bool = False,
) -> Equilibrium:
    """Solve for the steady state of `model` with `fixed` quantities from `guess`; `nominal` gives scales and branch.

    `branch` is the required `Branch`: a solution on another one has result `off_branch`. `not_converged` means that no
    zero was found near the guess, not that there is none. Differentiable in `model` and `fixed` by the implicit
    function theorem; the guess carries no gradient. Without `result == successful` the derivatives are as meaningless
    as the values.
    """
    weight = nominal.m * G
    x0, u0 = jax.lax.stop_gradient(guess)
    unknowns = jnp.stack([fixed.free(x0), u0.delta, u0.Fxr / weight])

    def point(y: Array) -> tuple[State, Control]:
        return fixed.point(y[0]), Control(y[1], y[2] * weight)

    def residual(y: Array, args: tuple) -> Array:
        model, nominal, fixed = args
        x, u = fixed.point(y[0]), Control(y[1], y[2] * nominal.m * G)
        return scaled_rates(nominal, x, model(x, u))

    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)
    args = (model, nominal, fixed)
    solution = optx.root_find(residual, solver, jax.lax.stop_gradient(unknowns), args, max_steps=100, throw=False)
    x, u = point(solution.value)
    worst = jnp.max(jnp.abs(residual(solution.value, args)))
    kind = classify(nominal, x, u)
    result = _judge(worst, (kind == branch) | (jnp.asarray(branch) == ANY))
    out = Equilibrium(x, u, worst, kind, solution.stats["num_steps"], jnp.ones_like(worst), result)
    return result.error_if(out, result != RESULTS.successful) if throw else out


def _judge(worst: Array, on_branch: Array) -> RESULTS:
    right = RESULTS.where(on_branch, RESULTS.successful, RESULTS.off_branch)  # pyright: ignore
    result = RESULTS.where(worst <= TOLERANCE, right, RESULTS.not_converged)  # pyright: ignore
    return RESULTS.where(jnp.isfinite(worst), result, RESULTS.non_finite)  # pyright: ignore


def solve_nominal(nominal: SingleTrack, fixed: SpeedYaw | SlipRadius, *, branch: Array | int) -> Equilibrium:
    """Solve for the nominal car's steady state on `branch` without a guess; `no_root` if the published car has none.

    With a friction ellipse the closed form of the published car, which has none, is the guess.
    """
    published = eqx.tree_at(lambda car: car.combined_slip, nominal, jnp.zeros_like(nominal.combined_slip))
    x, u, exists = pick(fixed.roots(published), branch)
    out = solve_equilibrium(nominal, nominal, fixed, (x, u), branch=branch)
    result = RESULTS.where(exists, out.result, RESULTS.no_root)  # pyright: ignore[reportArgumentType]
    return eqx.tree_at(lambda e: e.result, out, result)
