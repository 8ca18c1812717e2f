"""Find every steady state of the nominal car by scalar root-finding: initial guess of the solvers and test oracle.

With r_dot = 0 the axle forces share V r cos(beta) like the static loads, so that the unknowns separate (from Wu et al.
2025, Eq. 1-3, set to zero): the rear axle gives beta, the front axle then delta, and V_dot = 0 then Fxr.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from driftjax.core import Control, State
from driftjax.equilibrium.branch import classify
from driftjax.vehicle import SingleTrack
from driftjax.vehicle.single_track import G

GRID = 512  # cells of each scan; two roots closer than pi / GRID are missed (a fold)
NUM_BETA = 4
NUM_DELTA = 2  # the front axle's equation has the same sign at both ends of the scan: roots come in pairs


class Roots(NamedTuple):
    """Steady states at one (V, r); rows that are not `valid` are padding."""

    x: State  # fields (8,)
    u: Control  # fields (8,)
    kind: Array  # (8,) `Branch`
    valid: Array  # (8,)


def scan_roots(f: Callable[[Array], Array], lower: float, upper: float, size: int) -> tuple[Array, Array]:
    """Find at most `size` roots of scalar `f` in [lower, upper], ascending, and which are valid: scan, then bisect."""
    grid = jnp.linspace(lower, upper, GRID + 1)
    positive = jax.vmap(f)(grid) > 0
    (cell,) = jnp.nonzero(positive[1:] != positive[:-1], size=size, fill_value=GRID)
    bracketed = cell < GRID
    left, right, sign = grid[cell], grid[jnp.minimum(cell + 1, GRID)], positive[cell]

    def halve(_, ends):
        left, right = ends
        middle = 0.5 * (left + right)
        keep = (jax.vmap(f)(middle) > 0) == sign
        return jnp.where(keep, middle, left), jnp.where(keep, right, middle)

    left, right = jax.lax.fori_loop(0, 48, halve, (left, right))
    return jnp.where(bracketed, 0.5 * (left + right), 0.0), bracketed


def front_steer(nominal: SingleTrack, beta: Array, curvature: Array, ay: Array) -> tuple[Array, Array]:
    """Return the (2,) steering angles for the front axle's share of `ay` = V r cos(beta) [m/s^2], and which exist."""
    tyre = nominal.tyre
    alpha_0 = jnp.arctan2(jnp.sin(beta) + nominal.a * curvature, jnp.cos(beta))
    share = nominal.Fzf / G * ay
    f = lambda delta: tyre.lateral(alpha_0 - delta, nominal.Fzf) * jnp.cos(delta) - share
    return scan_roots(f, -0.5 * jnp.pi, 0.5 * jnp.pi, NUM_DELTA)


def _complete(nominal: SingleTrack, x: State, delta: Array) -> Control:
    """Add the force that keeps the speed constant: Fxr = Fyf sin(delta) - m V r sin(beta)."""
    Fyf, _ = nominal.lateral_forces(x, Control(delta, jnp.zeros_like(delta)))
    return Control(delta, Fyf * jnp.sin(delta) - nominal.m * x.V * x.r * jnp.sin(x.beta))


def decoupled_roots(nominal: SingleTrack, V: Array, r: Array) -> Roots:
    """Find every steady state of the nominal car at speed `V` [m/s] > 0 and yaw rate `r` [rad/s] != 0, either turn."""
    tyre, curvature = nominal.tyre, r / V

    def rear(beta: Array) -> Array:
        alpha_r = jnp.arctan2(jnp.sin(beta) - nominal.b * curvature, jnp.cos(beta))
        return tyre.lateral(alpha_r, nominal.Fzr) - nominal.Fzr / G * V * r * jnp.cos(beta)

    betas, beta_found = scan_roots(rear, -0.5 * jnp.pi, 0.5 * jnp.pi, NUM_BETA)
    deltas, delta_found = jax.vmap(lambda beta: front_steer(nominal, beta, curvature, V * r * jnp.cos(beta)))(betas)
    exists = (beta_found[:, None] & delta_found).ravel()
    one = jnp.ones(NUM_BETA * NUM_DELTA)
    x = State(V * one, jnp.repeat(betas, NUM_DELTA), r * one)
    u = _complete(nominal, x, deltas.ravel())
    return Roots(x, u, jnp.where(exists, classify(nominal, x, u), -1), exists)


def drift_roots(nominal: SingleTrack, beta: Array, R: Array) -> Roots:
    """Find the (2,) steady states at sideslip `beta` [rad] and radius `R` [m], positive to the left: V in closed form.

    The rear slip angle depends on beta and R only, so that V^2 = R (rear force per mass) / cos(beta).
    """
    curvature = 1.0 / R
    alpha_r = jnp.arctan2(jnp.sin(beta) - nominal.b * curvature, jnp.cos(beta))
    ay = G * nominal.tyre.lateral(alpha_r, nominal.Fzr) / nominal.Fzr
    square = ay * R / jnp.cos(beta)
    V = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    deltas, exists = front_steer(nominal, beta, curvature, ay)
    exists = exists & (square > 0)
    one = jnp.ones(NUM_DELTA)
    x = State(V * one, beta * one, V * curvature * one)
    u = _complete(nominal, x, deltas)
    return Roots(x, u, jnp.where(exists, classify(nominal, x, u), -1), exists)


def preference(x: State, u: Control) -> Array:
    """Return the rank of roots of one kind in either turn: most sideslip, then most steering into the turn."""
    return jnp.abs(x.beta) + 1e-6 * jnp.sign(x.r) * u.delta


def pick(roots: Roots, branch: Array | int) -> tuple[State, Control, Array]:
    """Return the root of kind `branch` with the most sideslip, and whether there is one (else arbitrary values).

    Close to V r = mu g a branch may have two: the other, near the rear axle's peak, is not a sustainable drift.
    """
    match = roots.kind == branch
    row = jnp.argmax(jnp.where(match, preference(roots.x, roots.u), -jnp.inf))
    x, u = jax.tree.map(lambda leaf: leaf[row], (roots.x, roots.u))
    return x, u, match[row]
