"""What was learnt of the car, at many stages of many lanes at once, with its derivatives entry by entry."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from driftjax.gp import bounded
from driftjax.gp.expansion import Expansion, expansions, pairs
from driftjax.solve.lane_ocp import Components
from driftjax.solve.sparse import Matrix, hessian
from driftjax.vehicle import Residual

NUM_INPUTS = 5  # V, beta, r, delta, Fxr


class Learnt(NamedTuple):
    """Residual rates (dV, dbeta, dr) at some stages."""

    d: Components
    J: Matrix  # derivatives [output][input]
    H: list[Matrix]  # second derivatives of each output


def learnt(residual: Residual, z: Components, unit: Sequence[Array | float]) -> Learnt:
    """The residual at z = (V, beta, r, delta, Fxr) over `unit`, arrays (..., batch), derivatives per that unit.

    Leaves of `residual` have a leading axis, of 1 where all lanes share it. Points are the columns of matrix products,
    all points of a lane in one product, or of all lanes.
    """
    lanes, shape = len(residual.gate), z[0].shape
    flat = jnp.stack([value * scale for value, scale in zip(z, unit, strict=True)]).reshape(NUM_INPUTS, -1, shape[-1])
    points = flat.reshape(NUM_INPUTS, 1, -1).T if lanes == 1 else flat.T  # (lanes, points, inputs) either way
    points = jnp.swapaxes(points, 0, 1) if lanes == 1 else points
    back = lambda a: jnp.moveaxis(a, 0, -1).reshape(*a.shape[1:-1], *shape)
    mean, near = jax.tree.map(back, jax.vmap(expansions)(residual.gp, points))
    wide = lambda a: a.T.reshape(3, *[1] * (len(shape) - 1), lanes)
    reach, gate = wide(jax.vmap(lambda gp: gp.reach)(residual.gp)), wide(residual.gate)
    each = [_bounded(mean, near, k, reach[k], gate[k], unit) for k in range(3)]
    return Learnt(*map(list, zip(*each, strict=True)))


def _bounded(
    mean: Expansion, near: Expansion, k: int, reach: Array, gate: Array, unit: Sequence[Array | float]
) -> tuple[Array, list[Array], Matrix]:
    """Output `k` of `Residual` with its derivatives, by the chain rule from those of mean and nearness."""
    value = lambda m, n: gate * bounded(m, n, reach)
    (by_m, by_n), ((mm, mn), (_, nn)) = hessian(value, mean.value[k], near.value[0])
    m = [unit[i] * mean.gradient[k, i] for i in range(NUM_INPUTS)]
    n = [unit[i] * near.gradient[0, i] for i in range(NUM_INPUTS)]
    H: Matrix = [[None] * NUM_INPUTS for _ in range(NUM_INPUTS)]
    for at, (i, j) in enumerate(pairs(NUM_INPUTS)):
        own = unit[i] * unit[j] * (by_m * mean.hessian[k, at] + by_n * near.hessian[0, at])
        H[i][j] = H[j][i] = own + mm * m[i] * m[j] + mn * (m[i] * n[j] + n[i] * m[j]) + nn * n[i] * n[j]
    return value(mean.value[k], near.value[0]), [by_m * a + by_n * b for a, b in zip(m, n, strict=True)], H
