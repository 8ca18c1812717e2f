"""What was learnt of the car, at many points at once and to second order."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.gp import bounded
from driftjax.gp.expansion import Expansion, expansions, firsts, pairs, seconds
from driftjax.solve.lane_ocp import Components
from driftjax.solve.sparse import Matrix, hessian
from driftjax.vehicle import Residual

NUM_INPUTS = 5  # V, beta, r, delta, Fxr
PAIRS = pairs(NUM_INPUTS)
DEGREES = np.array([0.5 if i == j else 1.0 for i, j in PAIRS])  # of a pair's term in a Taylor polynomial


class Nearby(NamedTuple):
    """Residual rates (dV, dbeta, dr) about some points, in SI."""

    z: Float[Array, "... 5"]
    value: Float[Array, "... 3"]
    gradient: Float[Array, "... 3 5"]
    hessian: Float[Array, "... 3 15"]  # of `PAIRS`

    def at(self, z: Float[Array, "5"]) -> Float[Array, "3"]:
        """The polynomial of second order about one point."""
        dz = z - self.z
        return self.value + self.gradient @ dz + self.hessian @ (DEGREES * firsts(dz) * seconds(dz))


class Learnt(NamedTuple):
    """Residual rates (dV, dbeta, dr) at some stages."""

    d: Components
    J: Matrix  # derivatives [output][input]
    H: list[Matrix]  # second derivatives of each output


def nearby(residual: Residual, z: Float[Array, "P 5"]) -> Nearby:
    """The residual at all points `z` = (V, beta, r, delta, Fxr), by products of matrices."""
    mean, near = expansions(residual.gp, z)
    found = _bounded(mean, near, residual.gp.reach[:, None], residual.gate[:, None])
    return Nearby(z, *(jnp.moveaxis(a, -1, 0) for a in found))


def learnt(residual: Residual, z: Components, unit: Sequence[Array | float]) -> Learnt:
    """The residual at z = (V, beta, r, delta, Fxr) over `unit`, arrays (..., batch), derivatives per that unit.

    Leaves of `residual` have a leading axis, of 1 where all lanes share it. Points are the columns of matrix products,
    all points of a lane in one product, or of all lanes.
    """
    lanes, shape = len(residual.gate), z[0].shape
    whole = jnp.stack([value * scale for value, scale in zip(z, unit, strict=True)])
    points = whole.reshape(NUM_INPUTS, -1, lanes).T  # (lanes, points, inputs)
    back = lambda a: jnp.moveaxis(a, 0, -1).reshape(*a.shape[1:-1], *shape)
    mean, near = jax.tree.map(back, jax.vmap(expansions)(residual.gp, points))
    wide = lambda a: a.T.reshape(3, *[1] * (len(shape) - 1), lanes)
    reach, gate = wide(jax.vmap(lambda gp: gp.reach)(residual.gp)), wide(residual.gate)
    found = _bounded(mean, near, reach, gate)
    J: Matrix = [[found.gradient[k, i] * unit[i] for i in range(NUM_INPUTS)] for k in range(3)]
    entry = {(i, j): found.hessian[:, at] * (unit[i] * unit[j]) for at, (i, j) in enumerate(PAIRS)}
    H = [[[entry[min(i, j), max(i, j)][k] for j in range(NUM_INPUTS)] for i in range(NUM_INPUTS)] for k in range(3)]
    return Learnt([found.value[k] for k in range(3)], J, H)


def _bounded(mean: Expansion, near: Expansion, reach: Array, gate: Array) -> Expansion:
    """`Residual` by the chain rule from mean and nearness; `reach` and `gate` have the axes of their values."""
    value = lambda m, n: gate * bounded(m, n, reach)
    n = jnp.broadcast_to(near.value, mean.value.shape)
    (by_m, by_n), ((mm, mn), (_, nn)) = jax.tree.map(lambda a: a[:, None], hessian(value, mean.value, n))
    (m1, m2), (n1, n2) = [tuple(jax.vmap(f)(e.gradient) for f in (firsts, seconds)) for e in (mean, near)]
    bend = by_m * mean.hessian + by_n * near.hessian + mm * m1 * m2 + mn * (m1 * n2 + n1 * m2) + nn * n1 * n2
    return Expansion(value(mean.value, n), by_m * mean.gradient + by_n * near.gradient, bend)
