"""Tuned parameters: logarithms of the factors on Q, R and the switching lead."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.control.driver import Driver

NAMES = ("Q_V", "Q_beta", "Q_r", "R_delta", "R_Fxr", "lead")


def scaled_drivers(drivers: Driver, p: Float[Array, " 6"]) -> Driver:
    """Multiply the weights on V, beta, r and both input changes, and the lead, of all `drivers` by exp(p)."""
    factor = jnp.exp(p)
    Q = drivers.ocp.Q * jnp.concatenate([factor[:3], jnp.ones(2)])
    values = (Q, drivers.ocp.R * factor[3:5], drivers.lead * factor[5])
    return eqx.tree_at(lambda d: (d.ocp.Q, d.ocp.R, d.lead), drivers, values)


def parameter_values(drivers: Driver, p: Float[np.ndarray, " 6"]) -> dict[str, Any]:
    """Return Q [SI], R [SI] and lead [m] at `p`."""
    now = scaled_drivers(drivers, jnp.asarray(p))
    every = np.concatenate([now.ocp.Q[0, :3], now.ocp.R[0], now.lead[:1]])
    return dict(zip(NAMES, every.tolist(), strict=True))
