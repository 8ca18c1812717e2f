"""Reference values along the planned path, and their samples over one MPC horizon."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.control.mpc import Reference
from driftjax.core import Control, State, as_float


class ReferenceTable(eqx.Module):
    """Reference of the controllers, on a uniform grid of arc length along the planned path (all SI)."""

    start: Array = eqx.field(converter=as_float)  # arc length of the first row [m]
    spacing: Array = eqx.field(converter=as_float)  # [m]
    speed: Float[Array, " n"]  # planned speed, for the speed control of pure pursuit [m/s]
    kappa: Float[Array, " n"]  # curvature of the path [1/m]
    V: Float[Array, " n"]  # state the drift controllers track: speed [m/s]
    beta: Float[Array, " n"]  # sideslip [rad]
    r: Float[Array, " n"]  # yaw rate [rad/s]
    e: Float[Array, " n"]  # offset [m]
    theta: Float[Array, " n"]  # heading error [rad]
    delta: Float[Array, " n"]  # steering that goes with it, first guess of the MPC [rad]
    Fxr: Float[Array, " n"]  # force that goes with it [N]
    drift_start: Array = eqx.field(converter=as_float)  # the planned drift section, along the path [m]
    drift_end: Array = eqx.field(converter=as_float)

    def row(self, values: Float[Array, " n"], s: Array) -> Array:
        """Return one column at arc length `s`, linear between rows, constant beyond the ends."""
        i, share = self._position(values, s)
        return values[i] + share * (values[i + 1] - values[i])

    def slope(self, values: Float[Array, " n"], s: Array) -> Array:
        """Return the derivative of one column by arc length at `s` [unit/m]; of the nearest rows beyond the ends."""
        i, _ = self._position(values, s)
        return (values[i + 1] - values[i]) / self.spacing

    def _position(self, values: Float[Array, " n"], s: Array) -> tuple[Array, Array]:
        """Return the row before `s` and the fraction of the way to the next one."""
        q = jnp.clip((s - self.start) / self.spacing, 0.0, values.shape[0] - 1.0)
        i = jnp.clip(jnp.floor(q).astype(int), 0, values.shape[0] - 2)
        return i, q - i

    def schedule(self, s: Array, num: int, dt: Array) -> Float[Array, " N+1"]:
        """Return the arc lengths at `num` steps of `dt` [s] from `s` on, at the reference speed."""

        def move(s, _):
            after = s + dt * self.row(self.V, s)
            return after, after

        return jnp.concatenate([s[None], jax.lax.scan(move, s, length=num)[1]])

    def inputs(self, s: Float[Array, " N"]) -> Float[Array, "N 2"]:
        """Return the reference steering [rad] and force [N] at `s`."""
        return jnp.stack([jax.vmap(lambda one, c=c: self.row(c, one))(s) for c in (self.delta, self.Fxr)], axis=1)

    def reference(self, s: Float[Array, " N+1"]) -> Reference:
        """Return the rows at the expected position of each stage of the horizon."""
        at = lambda values: jax.vmap(lambda one: self.row(values, one))(s)
        return Reference(at(self.V), at(self.beta), at(self.r), at(self.e), at(self.theta), at(self.kappa))

    def state(self, s: Array) -> tuple[State, Control]:
        """Return the reference state and input at `s`."""
        x = State(self.row(self.V, s), self.row(self.beta, s), self.row(self.r, s))
        return x, Control(self.row(self.delta, s), self.row(self.Fxr, s))
