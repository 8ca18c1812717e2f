"""A track as a curvilinear frame: pose and widths along it, projection onto it, rates in it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from driftjax.core import as_float

WINDOW = 12  # default half-width of the search window, in grid spacings
NEWTON = 6  # refinement steps; from half a grid spacing three reach round-off


class Track(eqx.Module):
    """Centre line on a uniform arc-length grid, with its distances to the borders.

    A closed track is periodic: grid point n would be point 0 again, one lap later. An open track goes on
    straight before 0 and after `length`, with the end's widths.
    """

    s: Array = eqx.field(converter=as_float)  # arc length of the grid points, from 0, uniform [m]
    x: Array = eqx.field(converter=as_float)  # [m]
    y: Array = eqx.field(converter=as_float)  # [m]
    psi: Array = eqx.field(converter=as_float)  # heading of the tangent, continuous (never wrapped) [rad]
    kappa: Array = eqx.field(converter=as_float)  # curvature, positive in left turns [1/m]
    w_right: Array = eqx.field(converter=as_float)  # distance to the right border, positive [m]
    w_left: Array = eqx.field(converter=as_float)  # distance to the left border, positive [m]
    length: Array = eqx.field(converter=as_float)  # of one lap, or end to end [m]
    closed: bool = eqx.field(static=True)

    @property
    def spacing(self) -> Array:
        """Return the distance between grid points [m]."""
        return self.length / (self.s.shape[0] if self.closed else self.s.shape[0] - 1)

    @property
    def turn(self) -> Array:
        """Return the heading gained in one lap, a multiple of 2 pi; 0 on an open track [rad]."""
        if not self.closed:
            return jnp.zeros_like(self.length)
        gained = self.psi[-1] - self.psi[0] + self.spacing * (self.kappa[-1] + self.kappa[0]) / 2
        return 2 * jnp.pi * jnp.round(gained / (2 * jnp.pi))

    def _cell(self, s: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return left and right grid index, fraction between them, number of whole laps, metres beyond an open end."""
        n = self.s.shape[0]
        if self.closed:
            laps, over = lax.stop_gradient(jnp.floor(s / self.length)), jnp.zeros_like(s)
            inside = s - laps * self.length
        else:
            inside = jnp.clip(s, 0.0, self.length)
            laps, over = jnp.zeros_like(s), s - inside
        q = inside / self.spacing
        i = jnp.clip(jnp.floor(lax.stop_gradient(q)), 0, n - 1 if self.closed else n - 2).astype(int)
        return i, (i + 1) % n, q - i, laps, over

    def pose(self, s: ArrayLike) -> tuple[Array, Array, Array, Array]:
        """Return `(x, y, psi, kappa)` at arc length `s`: cubic Hermite in x, y and psi, linear in kappa."""
        s = as_float(s)
        i, j, u, laps, over = self._cell(s)
        h, turn = self.spacing, self.turn
        psi_j = self.psi[j] + jnp.where(j < i, turn, 0.0)
        psi = hermite(u, self.psi[i], psi_j, h * self.kappa[i], h * self.kappa[j])
        x = hermite(u, self.x[i], self.x[j], h * jnp.cos(self.psi[i]), h * jnp.cos(psi_j))
        y = hermite(u, self.y[i], self.y[j], h * jnp.sin(self.psi[i]), h * jnp.sin(psi_j))
        kappa = jnp.where(over == 0, (1 - u) * self.kappa[i] + u * self.kappa[j], 0.0)
        return x + over * jnp.cos(psi), y + over * jnp.sin(psi), psi + laps * turn, kappa

    def widths(self, s: ArrayLike) -> tuple[Array, Array]:
        """Return `(w_right, w_left)` at arc length `s` [m], linear between grid points."""
        i, j, u, _, _ = self._cell(as_float(s))
        return (1 - u) * self.w_right[i] + u * self.w_right[j], (1 - u) * self.w_left[i] + u * self.w_left[j]

    def position(self, s: ArrayLike, e: ArrayLike) -> tuple[Array, Array]:
        """Return the world point at `s` and lateral offset `e` (left positive) [m]."""
        x, y, psi, _ = self.pose(s)
        return x - e * jnp.sin(psi), y + e * jnp.cos(psi)

    def project(self, x: ArrayLike, y: ArrayLike, s_guess: ArrayLike):
        """Return `(s, e)` of the foot point near `s_guess`; e > 0 is left of the centre line [m].

        Nearest of the points within 12 grid spacings of `s_guess`, then Newton on
        (p - c(s)) . t(s) = 0 with steps of at most one spacing: a neighbouring leg beyond that is never
        chosen. `s` continues from `s_guess`: on a closed track it may lie outside [0, length). Unique
        where |e kappa| < 1. Gradients are those of the exact foot point.
        """
        x, y, s_guess = as_float(x), as_float(y), lax.stop_gradient(as_float(s_guess))
        s = s_guess + WINDOW * self.spacing * jnp.linspace(-1.0, 1.0, 4 * WINDOW + 1)
        cx, cy, _, _ = self.pose(s)
        return self._refine(x, y, s[jnp.argmin((x - cx) ** 2 + (y - cy) ** 2)])

    def locate(self, x: ArrayLike, y: ArrayLike):
        """Return `(s, e)` of the nearest point of the whole centre line [m]; on a closed track 0 <= s < length."""
        x, y = as_float(x), as_float(y)
        i = jnp.argmin((x - self.x) ** 2 + (y - self.y) ** 2)
        s = self.s[i]
        if not self.closed:  # reach points far beyond the ends
            ahead = (x - self.x[i]) * jnp.cos(self.psi[i]) + (y - self.y[i]) * jnp.sin(self.psi[i])
            s = s + jnp.where(i == 0, jnp.minimum(ahead, 0.0), 0.0)
            s = s + jnp.where(i == self.s.shape[0] - 1, jnp.maximum(ahead, 0.0), 0.0)
        s, e = self._refine(x, y, s)
        return (s - self.length * lax.stop_gradient(jnp.floor(s / self.length)) if self.closed else s), e

    def _refine(self, x: Array, y: Array, s: Array) -> tuple[Array, Array]:
        def newton(s: Array, limit: Array) -> Array:
            cx, cy, psi, kappa = self.pose(s)
            along = (x - cx) * jnp.cos(psi) + (y - cy) * jnp.sin(psi)
            e = -(x - cx) * jnp.sin(psi) + (y - cy) * jnp.cos(psi)
            return s + jnp.clip(along / jnp.maximum(1 - kappa * e, 0.1), -limit, limit)

        s = lax.stop_gradient(s)
        coarse = lax.fori_loop(0, NEWTON, lambda _, s: newton(s, self.spacing), s)
        s = newton(lax.stop_gradient(coarse), self.spacing)  # one step with gradients: implicit differentiation
        cx, cy, psi, _ = self.pose(s)
        return s, -(x - cx) * jnp.sin(psi) + (y - cy) * jnp.cos(psi)


def hermite(u: Array, p: Array, q: Array, dp: Array, dq: Array) -> Array:
    """Return the cubic on u in [0, 1] with end values `p`, `q` and end slopes `dp`, `dq` per unit u."""
    v = 1 - u
    return v * v * ((1 + 2 * u) * p + u * dp) + u * u * ((1 + 2 * v) * q - v * dq)


def curvilinear_rates(V: Array, beta: Array, r: Array, e: Array, theta: Array, kappa: Array):
    """Return `(s_dot, e_dot, theta_dot)` of a car at offset `e`, heading `theta` left of the tangent.

    Wu et al. 2025, Eq. 7: s_dot = V cos(theta + beta)/(1 - e kappa), e_dot = V sin(theta + beta),
    theta_dot = r - kappa s_dot. Singular where e reaches the centre of curvature.
    """
    s_dot = V * jnp.cos(theta + beta) / (1 - e * kappa)
    return s_dot, V * jnp.sin(theta + beta), r - kappa * s_dot


def resample(S, x, y, psi, kappa, w_right, w_left, num: int, closed: bool = False) -> Track:
    """Resample a track from samples at increasing, uneven arc lengths `S` [m] to `num` even grid points.

    In JAX, so that a path that comes out of a solver stays differentiable. A closed path repeats its first
    point as the last sample.
    """
    S = S - S[0]
    grid = jnp.linspace(0.0, 1.0, num + 1 if closed else num)[:num] * S[-1]
    i = jnp.clip(jnp.searchsorted(lax.stop_gradient(S), lax.stop_gradient(grid), side="right") - 1, 0, len(S) - 2)
    h = S[i + 1] - S[i]
    u = (grid - S[i]) / h
    curve = lambda p, dp: hermite(u, p[i], p[i + 1], h * dp[i], h * dp[i + 1])
    line = lambda p: (1 - u) * p[i] + u * p[i + 1]
    x, y, psi_grid = curve(x, jnp.cos(psi)), curve(y, jnp.sin(psi)), curve(psi, kappa)
    widths = jax.tree.map(line, (w_right, w_left))
    return Track(grid, x, y, psi_grid, line(kappa), *widths, length=S[-1], closed=closed)
