"""Loss of a lap, as a sum of squares, and its derivatives through the closed loop."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from driftjax.control.driver import Driver
from driftjax.control.table import ReferenceTable
from driftjax.sim import AnyPlant, LapCode, LapConfig, Trace, drive
from driftjax.sim.sensors import SensorConfig
from driftjax.tune.blend import blended
from driftjax.tune.config import Scales
from driftjax.tune.parameters import NAMES, scaled_drivers

EDGE = 1.0  # length over which weights fade at the ends of the drift section [m]


class LapGradients(NamedTuple):
    """Loss of each entry with the smooth switch and its derivatives; zeros where they are not `valid`."""

    loss: Float[Array, " batch"]
    gradient: Float[Array, "batch 6"]
    gauss: Float[Array, "batch 6 6"]  # Gauss-Newton Hessian
    valid: Bool[Array, " batch"]  # lap completed, derivatives finite


def lap_errors(trace: Trace, table: ReferenceTable, scales: Scales) -> Float[Array, "steps 3"]:
    """Return the errors of one lap over the drift section, whose squares add up to means over distance.

    Lateral error, deviation from the planned sideslip, change of the steering command; weights fade over a metre at the
    ends of the section, so that no step enters or leaves with a jump.
    """
    s = trace.s
    weight = jax.nn.sigmoid((s - table.drift_start) / EDGE) * jax.nn.sigmoid((table.drift_end - s) / EDGE)
    ds = jnp.diff(s, append=s[-1:])
    counts = trace.alive & (ds > 0) & (weight > 1e-9)
    share = jnp.sqrt(jnp.where(counts, weight * ds, 1.0) / (table.drift_end - table.drift_start))
    planned = jax.vmap(lambda one: table.row(table.beta, one))(s)
    change = jnp.diff(trace.command.delta, prepend=trace.command.delta[:1])
    errors = jnp.stack([trace.e / scales.e, (trace.beta - planned) / scales.beta, change / scales.change], axis=1)
    return jnp.where(counts[:, None], share[:, None] * errors, 0.0)


def lap_loss(errors: Float[Array, "steps 3"], code: Array, scales: Scales) -> Float[Array, ""]:
    """Return the sum of squares, or the fixed loss of a lap that was not completed."""
    return jnp.where(code == int(LapCode.COMPLETED), jnp.sum(errors**2), scales.failed)


def gradients_batch(
    batch: tuple[Driver, AnyPlant, Array, Array],
    sensors: SensorConfig,
    lap: LapConfig,
    dt: float,
    scales: Scales,
    width: float,
) -> LapGradients:
    """Differentiate in forward mode through plant, sensors and solved MPC, for entries (drivers, plants, V0, keys)."""
    drivers, plants, speed, keys = batch

    def errors(p: Array) -> tuple[Array, tuple[Array, Array]]:
        now = scaled_drivers(drivers, p)
        memory = eqx.filter_vmap(lambda d: d.start())(now)
        policy = lambda sensed, memory, alive: blended(now, sensed, memory, alive, jnp.asarray(width))
        laps = drive(plants, now.path, speed, policy, memory, sensors, lap, dt=dt, keys=keys)
        of_laps = jax.vmap(lambda t, table: lap_errors(t, table, scales))(laps.trace, now.table)
        flat = of_laps.reshape(of_laps.shape[0], -1)
        return flat, (flat, laps.code)

    J, (flat, code) = jax.jacfwd(errors, has_aux=True)(jnp.zeros(len(NAMES)))
    valid = (code == int(LapCode.COMPLETED)) & jnp.all(jnp.isfinite(J), axis=(1, 2))
    J = jnp.where(valid[:, None, None], J, 0.0)
    loss = jax.vmap(lambda r, c: lap_loss(r, c, scales))(flat, code)
    return LapGradients(loss, 2 * jnp.einsum("li,lip->lp", flat, J), 2 * jnp.einsum("lip,liq->lpq", J, J), valid)
