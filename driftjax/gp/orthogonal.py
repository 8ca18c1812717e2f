r"""What a GP leaves to known causes: at its data it is orthogonal to the directions in which these can act.

Known causes change output y of n data by J c, J (n, k), whatever c is. A GP beside them can say J c too, so that it
takes what is theirs. Conditioned on $J^T g(X) = 0$ it cannot (Plumlee 2017; Plumlee and Joseph 2018, their integral
over the inputs being the sum over the data):
$k_\perp(x, x') = k(x, x') - k(x, X) J (J^T K J)^{-1} J^T k(X, x')$.
To observe y with noise $s^2 I$ beside $J^T g = 0$ without noise is to observe P y with noise $s^2 P$, P the projector
$I - J (J^T J)^{-1} J^T$. So mean and variance are those of the plain k with this noise and these targets:
mean(x) = $k(x, X) (K + s^2 P)^{-1} P y$, and a prediction costs what it always did.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

DEPENDENT = 1e-10  # share of the largest squared singular value below which a direction follows from the others


def _orthonormal(J: Float[Array, "M k"]) -> Float[Array, "k k"]:
    """T for which J T has orthonormal columns that span those of J; zero columns for what depends on others."""
    size = jnp.sqrt(jnp.sum(J**2, axis=0))
    unit = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1.0), 0.0)
    values, vectors = jnp.linalg.eigh(unit[:, None] * (J.T @ J) * unit)
    own = values > DEPENDENT * jnp.maximum(values[-1], 0.0)
    return unit[:, None] * vectors * jnp.where(own, 1 / jnp.sqrt(jnp.where(own, values, 1.0)), 0.0)


def _rows(basis: Float[Array, "M D k"], mask: Array) -> Float[Array, "D M k"]:
    return jnp.moveaxis(jnp.where(mask[:, None, None], basis, 0.0), 1, 0)


def directions(basis: Float[Array, "M D k"], mask: Array) -> Float[Array, "D M k"]:
    """Orthonormal directions Q of each output over the rows in `mask`, from its J; 0 in rows and columns to spare."""
    return jax.vmap(lambda J: J @ _orthonormal(J))(_rows(basis, mask))


def known_effect_part(Y: Array, basis: Array, mask: Array, elsewhere: Float[Array, "N D k"]) -> Float[Array, "N D"]:
    """What the known causes make of N points with the basis `elsewhere`, fitted to the data by least squares.

    Each output for itself. Data are targets `Y` (M, D) with their `basis` (M, D, k) where `mask`.
    """

    def one(J: Array, y: Array, other: Array) -> Array:
        T = _orthonormal(J)
        return other @ (T @ ((J @ T).T @ y))

    targets = jnp.where(mask[:, None], Y, 0.0).T
    return jax.vmap(one, out_axes=1)(_rows(basis, mask), targets, jnp.moveaxis(elsewhere, 1, 0))


def project_out(Y: Array, basis: Array, mask: Array) -> Float[Array, "M D"]:
    """P y of each output: the targets less what known causes can say of them; 0 outside `mask`."""
    rows = jnp.where(mask[:, None, None], basis, 0.0)
    return jnp.where(mask[:, None], Y - known_effect_part(Y, rows, mask, rows), 0.0)
