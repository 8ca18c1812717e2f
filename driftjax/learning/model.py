"""The learnt residual of one lane: a dictionary of informative rows, the GP on it, and how far to trust it."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from driftjax.gp import GP, claimed, condition, fit, scales, select_dictionary, unclaimed, zero_gp
from driftjax.learning.config import GPConfig
from driftjax.vehicle import Residual, no_residual

Claim = Callable[[Array], Array]  # of inputs (N, 5): what the parameters of known causes change there (N, 3, k)

BLOCK = 10  # rows that are held out together: neighbours in time share their noise after smoothing


class Memory(eqx.Module):
    """Rows kept so far and what was learnt from them, of one lane."""

    Z: Array  # (M, 5)
    Y: Array  # (M, 3)
    mask: Array  # (M,)
    residual: Residual


def empty(config: GPConfig, lags: Array | None = None) -> Memory:
    """Memory of a lane that has not driven; `lags` (2,) of its actuators may be known all the same [s]."""
    M = config.size
    gp = zero_gp(M, 5, 3, config.kernel)
    residual = no_residual(gp, lags, config.bounded)
    return Memory(jnp.zeros((M, 5)), jnp.zeros((M, 3)), jnp.zeros(M, bool), residual)


def learn(
    memory: Memory,
    Z: Array,
    Y: Array,
    mask: Array,
    lags: Array,
    config: GPConfig,
    key: Array,
    claim: Claim | None = None,
    shortest: Array | None = None,
) -> Memory:
    """`memory` with a lap's rows added: new dictionary, new GP, new gate; `lags` (2,) are those of the lap.

    The gate of an output is the factor within 0..1 on the mean that leaves least of rows which the GP was not
    conditioned on (Breiman 1996, Stacked Regressions, of one model): noise of the rows does not lower it, a mean that
    says too much or the wrong thing does. What known causes could say by `claim` the GP leaves to them.
    `shortest` goes before that of `config`: a number that need not be known to compile.
    """
    Z, Y = jnp.concatenate([memory.Z, Z]), jnp.concatenate([memory.Y, Y])
    mask = jnp.concatenate([memory.mask, mask])
    kept = select_dictionary(Z, Y, mask, config.size, kernel=config.kernel)
    found = fit(
        *kept, num_restarts=config.restarts, max_iterations=config.max_iterations, num_fit=config.num_fit,
        kernel=config.kernel, shortest=config.shortest if shortest is None else shortest,
        basis=None if claim is None else claim(kept[0]), key=key,
    )  # fmt: skip
    gate = trust(found.gp, Z, Y, mask, config, claim)
    enough = jnp.sum(kept[2]) >= 20
    lags = jnp.where(enough, lags, memory.residual.lags)
    residual = Residual(found.gp, jnp.where(enough & jnp.isfinite(gate), gate, 0.0), lags, config.bounded)
    return Memory(*kept, residual)


def trust(gp: GP, Z: Array, Y: Array, mask: Array, config: GPConfig, claim: Claim | None = None) -> Array:
    """(3,) in 0..1: least-squares factor on the mean at every second block of rows of a GP conditioned on the other
    blocks; of the targets there only what known causes leave, whose share the other blocks say."""
    fold = (jnp.arange(len(mask)) // BLOCK) % 2 == 0
    train = select_dictionary(Z, Y, mask & fold, config.size, kernel=config.kernel)
    if claim is None:
        half = condition(*train, gp.hyper, *scales(*train), config.kernel)
    else:
        inputs, targets, kept = train
        basis = claim(inputs)
        Y = Y - claimed(targets, basis, kept, claim(Z))
        scale = scales(inputs, unclaimed(targets, basis, kept), kept)
        half = condition(*train, gp.hyper, *scale, config.kernel, basis)
    test = (mask & ~fold)[:, None]
    mean, left = (jnp.where(test, values, 0.0) for values in (jax.vmap(half.bounded_mean)(Z), Y))
    power = jnp.sum(mean**2, axis=0)
    return jnp.clip(jnp.sum(mean * left, axis=0) / jnp.where(power > 0, power, jnp.inf), 0.0, 1.0)
