"""Expand the learnt residual to second order at many points at once."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from driftjax.gp import bound_mean
from driftjax.gp.expansion import Expansion, expansions, pairs
from driftjax.solve.batch_ocp import Components
from driftjax.solve.component_derivatives import Matrix, hessian
from driftjax.solve.compute_once import compute_once
from driftjax.vehicle import Residual

NUM_INPUTS = 5  # V, beta, r, delta, Fxr
PAIRS = pairs(NUM_INPUTS)


class ResidualDerivatives(NamedTuple):
    """Residual rates (dV, dbeta, dr) and their derivatives at several stages."""

    d: Components
    J: Matrix  # derivatives [output][input]
    H: list[Matrix]  # second derivatives of each output


def residual_derivatives(residual: Residual, z: Components, unit: Sequence[Array | float]) -> ResidualDerivatives:
    """Return the residual and its derivatives at z = (V, beta, r, delta, Fxr) over `unit`, arrays (..., batch).

    Derivatives are per that unit. Leaves of `residual` have a leading axis, of 1 where all entries share it.
    """
    at = compute_once(_expanded)(residual, [value * scale for value, scale in zip(z, unit, strict=True)])
    J: Matrix = [[at.gradient[i][k] * unit[i] for i in range(NUM_INPUTS)] for k in range(3)]
    entry = {(i, j): at.hessian[pair] * (unit[i] * unit[j]) for pair, (i, j) in enumerate(PAIRS)}
    H = [[[entry[min(i, j), max(i, j)][k] for j in range(NUM_INPUTS)] for i in range(NUM_INPUTS)] for k in range(3)]
    return ResidualDerivatives([at.value[k] for k in range(3)], J, H)


def _expanded(residual: Residual, z: Sequence[Array]) -> Expansion:
    """Expand `Residual` to second order by the chain rule, from mean and nearness, at inputs (..., batch)."""
    mean, near = expansions(residual.gp, z)
    wide = lambda a: a.T.reshape(3, *[1] * (z[0].ndim - 1), len(a))
    reach, trust_factor = wide(jax.vmap(lambda gp: gp.reach)(residual.gp)), wide(residual.trust_factor)
    value = lambda m, n: trust_factor * (bound_mean(m, n, reach) if residual.bounded else m)
    n = jnp.broadcast_to(near.value, mean.value.shape)
    (by_m, by_n), ((mm, mn), (_, nn)) = hessian(value, mean.value, n)
    dm, dn = mean.gradient, near.gradient
    gradient = [by_m * a + by_n * b for a, b in zip(dm, dn, strict=True)]
    bend = [
        by_m * hm + by_n * hn + mm * dm[i] * dm[j] + mn * (dm[i] * dn[j] + dn[i] * dm[j]) + nn * dn[i] * dn[j]
        for (i, j), hm, hn in zip(PAIRS, mean.hessian, near.hessian, strict=True)
    ]
    return Expansion(value(mean.value, n), gradient, bend)
