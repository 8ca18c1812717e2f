"""Exact Gaussian process with padded data of fixed size: predict, condition, and the GP without data."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import cho_solve, solve_triangular

from driftjax.gp.kernel import KERNELS
from driftjax.gp.orthogonal import orthonormal_basis, project_out

FADE_LENGTH = 3.0  # length scale of the fade, in standard deviations of the inputs, however long the kernel's own are
FADE_RATE = 5.0  # one data point at zero distance already gives 1 - exp(-5) = 0.993 of the mean
JITTER = 100.0  # added to the diagonal, in units of eps times the signal variance


def saturate(x: Array) -> Array:
    """Return x / (1 + x^4)^(1/4): x within 1.5 % up to 1/2, and at most 1 in magnitude."""
    return x * jax.lax.rsqrt(jnp.sqrt(1 + x**4))


def fade_factor(near: Array) -> Array:
    """Return the fade factor: 1 where the summed nearness of the data is large, 0 far from all data."""
    return -jnp.expm1(-FADE_RATE * near)


def bound_mean(mean: Array, near: Array, reach: Array) -> Array:
    """Return `mean` faded out far from the data and limited to `reach` in magnitude; smooth."""
    return reach * saturate(fade_factor(near) * mean / reach)


class Hyper(eqx.Module):
    """Hyper-parameters of the D outputs, for inputs and outputs divided by their scales."""

    log_lengthscale: Array  # (D, nf), one length per input (automatic relevance determination)
    log_amplitude: Array  # (D,), log of the standard deviation of the latent function
    log_noise: Array  # (D,), log of the standard deviation of the noise


def squared_differences(X: Array) -> Array:
    """Return (nf, M, M): squared difference of every pair of scaled inputs `X` (M, nf), per input."""
    return jax.vmap(lambda x: (x[:, None] - x[None, :]) ** 2)(X.T)


def squared_distances(hyper: Hyper, pairs: Array) -> Array:
    """Return (M, M): squared distances in length scales of ONE output; `pairs` by `squared_differences`."""
    return jnp.tensordot(jnp.exp(-2 * hyper.log_lengthscale), pairs, axes=1)


def gram(kernel: str, hyper: Hyper, pairs: Array, mask: Array, Q: Array | None = None) -> Array:
    """Return the Gram matrix K + noise of ONE output; `pairs` by `squared_differences`, identity in masked rows.

    The squared differences do not depend on the hyper-parameters, so starts and outputs share them. In the directions
    `Q` (M, k) the GP is constrained to 0, which is observed without noise: see `orthogonal`.
    """
    q = squared_distances(hyper, pairs)
    amplitude, noise = jnp.exp(2 * hyper.log_amplitude), jnp.exp(2 * hyper.log_noise)
    jitter = JITTER * jnp.finfo(q.dtype).eps * amplitude
    K = jnp.where(mask[:, None] & mask[None, :], amplitude * KERNELS[kernel](q), 0.0)
    K = K + jnp.diag(jnp.where(mask, noise + jitter, 1.0))
    return K if Q is None else K - noise * (Q @ Q.T)


class GP(eqx.Module):
    """Exact GP, one per output, zero prior mean (Wu et al. 2025, Sec. III-B; Rasmussen and Williams 2006).

    Inputs and outputs are in the raw units of the data. Rows with a false `mask` are padding. If known effects have a
    basis, P below is the projector of `orthogonal`; else it is the identity.
    """

    kernel: str = eqx.field(static=True)  # name in `KERNELS`
    hyper: Hyper
    Z: Array  # (M, nf) inputs
    mask: Array  # (M,) which rows are data
    scale: Array  # (nf,) of the inputs
    output_scale: Array  # (D,)
    lower: Array  # (D,) smallest target seen, at most 0
    upper: Array  # (D,) largest target seen, at least 0
    alpha: Array  # (D, M) = (K + noise P)^-1 P y, scaled
    L: Array  # (D, M, M) Cholesky factor of K + noise P, scaled

    def correlations(self, z: Array) -> Array:
        """Return (D, M): k(z, Z_i) over the signal variance, 0 for masked rows."""
        inverse = jnp.exp(-self.hyper.log_lengthscale) / self.scale
        q = jnp.square(inverse) @ jnp.square(z - self.Z).T
        return jnp.where(self.mask, KERNELS[self.kernel](q), 0.0)

    def _mean(self, correlations: Array) -> Array:
        size = jnp.exp(2 * self.hyper.log_amplitude) * self.output_scale
        return size * jnp.sum(correlations * self.alpha, axis=-1)

    def mean(self, z: Array) -> Array:
        """Return the posterior mean (D,) at one input `z` (nf,); O(D M nf), no solves."""
        return self._mean(self.correlations(z))

    def gradient(self, z: Array) -> Array:
        """Return the derivative (D, nf) of the posterior mean in the input `z` (nf,)."""
        return jax.jacfwd(self.mean)(z)

    def _nearness(self, z: Array) -> Array:
        """Return the nearness (M,) of every data point, 1 at distance zero."""
        offset = (z - self.Z) / (FADE_LENGTH * self.scale)
        return jnp.where(self.mask, jnp.exp(-0.5 * jnp.sum(offset**2, axis=-1)), 0.0)

    def fade(self, z: Array) -> Array:
        """Return the fade factor: 1 near data, smoothly 0 far from it: 1 - exp(-c sum_i exp(-|z - Z_i|^2 / 2 l^2))."""
        return fade_factor(jnp.sum(self._nearness(z)))

    def bounded_mean(self, z: Array) -> Array:
        """Return the mean (D,) times the fade factor, limited to twice the largest target: safe for a controller.

        Smooth: a hard limit has a kink at which a solver of optimality conditions cannot converge.
        """
        return bound_mean(self.mean(z), jnp.sum(self._nearness(z)), self.reach)

    @property
    def reach(self) -> Array:
        """Return the limit (D,) of `bounded_mean`: twice the largest target."""
        largest = jnp.maximum(-self.lower, self.upper)
        return jnp.where(largest > 0, 2 * largest, 1.0)

    @property
    def prior_variance(self) -> Array:
        """Return the latent variance (D,) without data."""
        return jnp.exp(2 * self.hyper.log_amplitude) * self.output_scale**2

    def variance(self, z: Array) -> Array:
        """Return the posterior variance (D,) of the latent function (without the noise) at one input `z` (nf,)."""
        k = jnp.exp(2 * self.hyper.log_amplitude)[:, None] * self.correlations(z)
        v = jax.vmap(lambda L, k: solve_triangular(L, k, lower=True))(self.L, k)
        latent = jnp.exp(2 * self.hyper.log_amplitude) - jnp.sum(v**2, axis=-1)
        return jnp.maximum(latent, 0.0) * self.output_scale**2  # rounding may leave -1e-16

    def covariance(self, z: Array) -> Array:
        """Return the posterior covariance (D, P, P) of the latent function between the inputs `z` (P, nf)."""
        amplitude = jnp.exp(2 * self.hyper.log_amplitude)
        k = amplitude[:, None, None] * jnp.moveaxis(jax.vmap(self.correlations)(z), 0, 2)  # (D, M, P)
        v = jax.vmap(lambda L, k: solve_triangular(L, k, lower=True))(self.L, k)

        def prior(log_lengthscale: Array) -> Array:
            a = z / self.scale * jnp.exp(-log_lengthscale)
            return KERNELS[self.kernel](jnp.sum((a[:, None] - a[None]) ** 2, axis=-1))

        latent = amplitude[:, None, None] * jax.vmap(prior)(self.hyper.log_lengthscale) - jnp.moveaxis(v, 1, 2) @ v
        return latent * self.output_scale[:, None, None] ** 2

    @property
    def noise_variance(self) -> Array:
        """Return the variance (D,) of the noise of the targets."""
        return jnp.exp(2 * self.hyper.log_noise) * self.output_scale**2


def data_scales(Z: Array, Y: Array, mask: Array) -> tuple[Array, Array]:
    """Return the standard deviation of each input and the root mean square of each output; 1 where it is 0."""
    Z, Y = jnp.where(mask[:, None], Z, 0.0), jnp.where(mask[:, None], Y, 0.0)
    n = jnp.maximum(jnp.sum(mask), 1)
    weight = mask[:, None] / n
    centre = jnp.sum(weight * Z, axis=0)
    variance = jnp.sum(weight * (Z - centre) ** 2, axis=0)
    constant = variance <= (1e3 * jnp.finfo(Z.dtype).eps * centre) ** 2
    square = jnp.sum(weight * Y**2, axis=0)
    scale = jnp.where(constant, 1.0, jnp.sqrt(jnp.where(constant, 1.0, variance)))
    return scale, jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 1.0)


def condition(
    Z: Array,
    Y: Array,
    mask: Array,
    hyper: Hyper,
    scale: Array,
    output_scale: Array,
    kernel: str,
    basis: Array | None = None,
) -> GP:
    """Return the GP conditioned on `Z` (M, nf) and targets `Y` (M, D) where `mask`, with given hyper-parameters.

    At these data it is orthogonal to `basis` (M, D, k), the directions of known effects; see `orthogonal`.
    """
    mask = mask.astype(bool)
    Z, Y = jnp.where(mask[:, None], Z, 0.0), jnp.where(mask[:, None], Y, 0.0)
    if basis is not None:
        Y = project_out(Y, basis, mask)

    pairs = squared_differences(Z / scale)

    def factor(hyper: Hyper, y: Array, *Q: Array) -> tuple[Array, Array]:
        L = jnp.linalg.cholesky(gram(kernel, hyper, pairs, mask, *Q))
        return L, cho_solve((L, True), y)

    held = () if basis is None else (orthonormal_basis(basis, mask),)
    L, alpha = jax.vmap(factor)(hyper, (Y / output_scale).T, *held)
    lower, upper = jnp.min(Y, axis=0, initial=0.0), jnp.max(Y, axis=0, initial=0.0)
    return GP(kernel, hyper, Z, mask, scale, output_scale, lower, upper, alpha, L)


@eqx.filter_jit
def zero_gp(M: int, nf: int, D: int, kernel: str = "se") -> GP:
    """Return a GP without data: mean 0, in the shapes of one fitted on `M` rows (so nothing recompiles)."""
    dtype = jnp.result_type(float)
    hyper = Hyper(jnp.zeros((D, nf), dtype), jnp.zeros(D, dtype), jnp.full(D, jnp.log(0.1), dtype))
    Z, Y, mask = jnp.zeros((M, nf), dtype), jnp.zeros((M, D), dtype), jnp.zeros(M, bool)
    return condition(Z, Y, mask, hyper, jnp.ones(nf, dtype), jnp.ones(D, dtype), kernel)
