"""A driver with a smooth switch, whose laps are differentiable by the switching lead."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from driftjax.control.driver import Decision, Driver, DriverState, decide
from driftjax.core import Control, lag_step
from driftjax.sim import Sensed


def blended(
    drivers: Driver, sensed: Sensed, memory: DriverState, alive: Array, width: Array
) -> tuple[Control, DriverState, Decision]:
    """Apply `decide` to the batch, with the drift controller blended in along `width` [m] about its lead.

    The command changes from pure pursuit to the drift MPC along a cubic in s. With the hard switch a lap is a step
    function of the lead, which jumps at control steps, and has no useful derivative. The smooth switch has one, and
    tends to the hard switch as the width goes to 0. The switch back after the corner stays hard: it lies after the
    evaluated section.
    """
    over_batch = eqx.filter_vmap
    early = eqx.tree_at(lambda d: d.lead, drivers, drivers.lead + width / 2)
    command, after, decision = decide(early, sensed, memory, alive)
    pursued = over_batch(lambda d, x, m: d.pursue(x, m))(drivers, sensed, memory)
    share = jnp.clip((sensed.s - drivers.table.drift_start + drivers.lead) / width + 0.5, 0.0, 1.0)
    share = jnp.where(decision.drifting, share**2 * (3 - 2 * share), 0.0)[:, None]
    mixed = pursued + share * (jnp.stack(command, axis=1) - pursued)
    lags, dt = drivers.ocp.residual.lags, drivers.ocp.dt[:, None]
    lagged_input = lag_step(memory.lagged_input, mixed, lags, dt)[1]
    return Control(mixed[:, 0], mixed[:, 1]), after._replace(command=mixed, lagged_input=lagged_input), decision
