"""Exact Gaussian process of one output with any kernel, given as a function k(parameters, z1, z2) of two points.

Gradients are automatic. For the kernels of `KERNELS` the fit with closed-form derivatives (`fit_masked`) is faster.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Float, Int, PyTree

from driftjax.core import RESULTS
from driftjax.core.bounded import minimise_within
from driftjax.environment import require_float64

Kernel = Callable[[PyTree, Float[Array, " nf"], Float[Array, " nf"]], Float[Array, ""]]


class KernelGP(eqx.Module):
    """GP conditioned on `Z` and `y`, in their units, with zero prior mean, and the diagnostics of its fit."""

    kernel: Kernel = eqx.field(static=True)
    parameters: PyTree  # of the kernel, as the bounds of the fit
    noise: Float[Array, ""]  # standard deviation of the measurement noise
    Z: Float[Array, "n nf"]
    alpha: Float[Array, " n"]  # (K + noise^2)^-1 y
    L: Float[Array, "n n"]  # Cholesky factor of K + noise^2
    log_marginal_likelihood: Float[Array, ""]
    error: Float[Array, ""]  # largest projected gradient of the likelihood per data row, by log parameters
    num_steps: Int[Array, ""]
    result: RESULTS

    def _covariances(self, z: Array) -> Array:
        return jax.vmap(lambda one: self.kernel(self.parameters, z, one))(self.Z)

    def mean(self, z: Float[Array, " nf"]) -> Float[Array, ""]:
        """Return the posterior mean at one input (Rasmussen and Williams 2006, Eq. 2.25)."""
        return self._covariances(z) @ self.alpha

    def variance(self, z: Float[Array, " nf"]) -> Float[Array, ""]:
        """Return the posterior variance of the function, without the noise (Rasmussen and Williams 2006, Eq. 2.26)."""
        v = solve_triangular(self.L, self._covariances(z), lower=True)
        return jnp.maximum(self.kernel(self.parameters, z, z) - v @ v, 0.0)  # rounding may leave -1e-16


def _covariance(kernel: Kernel, parameters: PyTree, noise: Array, Z: Array) -> Array:
    K = jax.vmap(lambda a: jax.vmap(lambda b: kernel(parameters, a, b))(Z))(Z)
    return K + noise**2 * jnp.eye(len(Z), dtype=Z.dtype)


def _likelihood(K: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return the log marginal likelihood (Rasmussen and Williams 2006, Eq. 2.30), alpha and the Cholesky factor."""
    L = jnp.linalg.cholesky(K)
    alpha = cho_solve((L, True), y)
    return -0.5 * y @ alpha - jnp.sum(jnp.log(jnp.diagonal(L))) - 0.5 * y.size * jnp.log(2 * jnp.pi), alpha, L


@eqx.filter_jit
def fit_kernel(
    kernel: Kernel,
    Z: Float[Array | np.ndarray, "n nf"],
    y: Float[Array | np.ndarray, " n"],
    lower: PyTree,
    upper: PyTree,
    *,
    noise: tuple[float, float] = (1e-3, 2.0),
    num_restarts: int = 4,
    max_steps: int = 200,
    tolerance: float = 1e-6,
    key: Array,
) -> KernelGP:
    """Return the GP of inputs `Z` and targets `y` whose parameters maximise the marginal likelihood.

    `kernel(parameters, z1, z2)` must be differentiable, also where z1 = z2. Parameters have the structure of `lower`
    and `upper`, all positive; bounds of the `noise` are in the units of `y`. The search runs in their logarithms, from
    the middle of the bounds and `num_restarts` - 1 random points, until the projected gradient per data row is at most
    `tolerance`. `result` is that of the best start: `not_positive_definite` where the covariance has no Cholesky factor
    at any, `non_finite` where data or kernel are not finite, or the result of `minimise_within`.
    """
    require_float64()
    Z, y = jnp.asarray(Z), jnp.asarray(y)
    low, unravel = ravel_pytree(jax.tree.map(lambda a: jnp.log(jnp.asarray(a, Z.dtype)), (lower, noise[0])))
    high, _ = ravel_pytree(jax.tree.map(lambda a: jnp.log(jnp.asarray(a, Z.dtype)), (upper, noise[1])))
    natural = lambda x: jax.tree.map(jnp.exp, unravel(x))
    covariance = lambda x, Z: _covariance(kernel, natural(x)[0], natural(x)[1], Z)
    cost = lambda x, Z, y: -_likelihood(covariance(x, Z), y)[0] / y.size
    shares = jax.random.uniform(key, (num_restarts, low.size), Z.dtype).at[0].set(0.5)
    search = lambda x: minimise_within(cost, x, low, high, Z, y, tolerance=tolerance, max_steps=max_steps)
    ends = jax.vmap(search)(low + shares * (high - low))
    best = jax.tree.map(lambda leaf: leaf[jnp.argmin(ends.value)], ends)
    K = covariance(best.x, Z)
    value, alpha, L = _likelihood(K, y)
    finite = jnp.all(jnp.isfinite(K)) & jnp.all(jnp.isfinite(y))
    indefinite = finite & ~jnp.all(jnp.isfinite(L))
    result = RESULTS.where(indefinite, RESULTS.not_positive_definite, best.result)  # pyright: ignore[reportArgumentType]
    parameters, deviation = natural(best.x)
    return KernelGP(kernel, parameters, deviation, Z, alpha, L, value, best.error, best.num_steps, result)
