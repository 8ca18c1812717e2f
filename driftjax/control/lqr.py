"""LQR around a drift equilibrium: a controller that the paper compares with."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State, rk4_step

SWEEPS = 500  # Riccati iterations; drift equilibria converge in under 100


class LQR(eqx.Module):
    """u = u_eq - K (x - x_eq) on (V, beta, r)."""

    K: Float[Array, "2 3"]

    def __call__(self, x: State, x_eq: State, u_eq: Control) -> Control:
        """Return the command, without limits."""
        error = jnp.stack([x.V - x_eq.V, x.beta - x_eq.beta, x.r - x_eq.r])
        correction = self.K @ error
        return Control(u_eq.delta - correction[0], u_eq.Fxr - correction[1])


@eqx.filter_jit  # without it the loop would be compiled, and stored, in every call
def lqr(
    model: Callable[[State, Control], State],
    x: State,
    u: Control,
    Q: Float[Array, " 3"],
    R: Float[Array, " 2"],
    dt: Array,
) -> LQR:
    """Compute the infinite-horizon discrete LQR of `model` linearised at (x, u), weights as in the MPC (all SI).

    The MPC penalises input changes; a static gain cannot, so `R` here penalises deviations from u_eq.
    """

    def step(x: Array, u: Array) -> Array:
        end = rk4_step(lambda w: model(w, Control(u[0], u[1])), State(x[0], x[1], x[2]), dt)
        return jnp.stack(end)

    A, B = jax.jacfwd(step, (0, 1))(jnp.stack(x), jnp.stack(u))
    scale = jnp.sqrt(R)  # inputs in units of their own cost keep the 2x2 solve well conditioned
    B = B / scale

    def sweep(_, P):
        S = B.T @ P @ A
        P = jnp.diag(Q) + A.T @ P @ A - S.T @ jnp.linalg.solve(jnp.eye(2) + B.T @ P @ B, S)
        return (P + P.T) / 2  # an antisymmetric rounding error would grow with the unstable modes of A

    P = jax.lax.fori_loop(0, SWEEPS, sweep, jnp.diag(Q))
    return LQR(jnp.linalg.solve(jnp.eye(2) + B.T @ P @ B, B.T @ P @ A) / scale[:, None])
