"""Drive one stage of the experiment: one lap per batch entry, and its figures."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.control.driver import Driver, decide
from driftjax.control.table import ReferenceTable
from driftjax.core import Control, State, features
from driftjax.learning.metrics import LapFigures, lap_figures
from driftjax.learning.scenario import Scenario
from driftjax.parallel import vmap_batch
from driftjax.sim import AnyPlant, LapCode, LapConfig, Laps, Trace, drive
from driftjax.sim.sensors import SensorConfig
from driftjax.vehicle import Residual

MEASURED = ("V", "beta", "r", "x", "y", "psi", "s", "e", "theta")


class StageResult(eqx.Module):
    """Laps of one stage, the references they tracked and their figures (leading axis: batch)."""

    laps: Laps
    table: ReferenceTable
    V_ref: Array  # reference speed where the car was (batch, steps)
    figures: LapFigures


def drive_batch(
    batch: tuple[Driver, AnyPlant, Array, Array], sensors: SensorConfig, lap: LapConfig, dt: float
) -> tuple[Trace, Array, Array, LapFigures]:
    """Return traces, lap codes, reference speeds and figures of entries (drivers, plants, initial speeds, keys)."""
    drivers, plants, speed, keys = batch
    memory = vmap_batch(lambda d: d.start())(drivers)
    policy = lambda sensed, memory, alive: decide(drivers, sensed, memory, alive)
    laps = drive(plants, drivers.path, speed, policy, memory, sensors, lap, dt=dt, keys=keys)
    table = drivers.table
    V_ref = vmap_batch(lambda t, s: jax.vmap(lambda one: t.row(t.V, one))(s))(table, laps.trace.s)
    judged = lambda trace, code, table, V: lap_figures(trace, code, table, V, lap.lost_error)
    figures = vmap_batch(judged)(laps.trace, laps.code, table, V_ref)
    return laps.trace, laps.code, V_ref, figures


def run_stage(scenario: Scenario, drivers: Driver, number: int) -> StageResult:
    """Drive stage `number` for the whole batch; each stage has its own noise."""
    config = scenario.config
    keys = jax.vmap(lambda key: jax.random.fold_in(key, number))(scenario.keys)
    speed = jnp.full(scenario.batch_size, scenario.plan.V[0])
    batch = (drivers, scenario.plants, speed, keys)
    laps = scenario.executor.map_blocks(drive_batch, batch, scenario.sensors, config.lap, config.mpc.dt)
    trace, code, V_ref, figures = laps
    return StageResult(Laps(trace, code, jnp.asarray(config.mpc.dt)), drivers.table, V_ref, figures)


@eqx.filter_jit
def _driven_rows(tables: ReferenceTable, s: Array) -> tuple[Array, Array, Array]:
    """Return sideslip, yaw rate and offset of each entry's table (leading axis) where its car was."""
    return jax.vmap(lambda t, s: (t.row(t.beta, s), t.row(t.r, s), t.row(t.e, s)))(tables, s)


@eqx.filter_jit
def gp_deviation(residual: Residual, trace: Trace) -> Array:
    """Return the GP's standard deviation (batch, steps, 3) [SI per second] where each car was; NaN without data.

    Of the latent rate error, without the noise, at the true state and the actuator values reached.
    """
    z = features(State(trace.V, trace.beta, trace.r), Control(trace.delta, trace.Fxr))
    variance = jax.vmap(lambda gp, z: jax.vmap(gp.variance)(z))(residual.gp, z)
    return jnp.where(jnp.any(residual.gp.mask, axis=1)[:, None, None], jnp.sqrt(variance), jnp.nan)


def stage_values(scenario: Scenario, stage: StageResult, kind: str) -> dict[str, np.ndarray]:
    """Return the stage as named arrays for the run folder (see `driftjax.store.variables`)."""
    trace, table = stage.laps.trace, stage.table
    beta_ref, r_ref, e_ref = _driven_rows(table, trace.s)
    values = {name: getattr(trace, name) for name in ("V", "beta", "r", "x", "y", "psi", "s", "e", "delta", "Fxr")}
    values |= {f"{name}_measured": getattr(trace.sensed, name) for name in MEASURED}
    values |= {"alive": trace.alive, "delta_command": trace.command.delta, "Fxr_command": trace.command.Fxr}
    values |= {name: getattr(trace.decision, name) for name in ("drifting", "solved", "kkt", "num_steps")}
    values |= {"V_ref": stage.V_ref, "beta_ref": beta_ref, "r_ref": r_ref, "e_ref": e_ref}
    values |= {"code": stage.laps.code, **stage.figures._asdict()}
    values |= {"t": stage.laps.dt * np.arange(trace.s.shape[1])}
    values |= {
        "plant": np.array([entry.plant for entry in scenario.batch], object),
        "controller": np.array([kind if kind == "pursuit" else entry.controller for entry in scenario.batch], object),
        "seed": np.array([entry.seed for entry in scenario.batch]),
    }
    return {name: np.asarray(value) for name, value in values.items()}


CODES = {code.name: int(code) for code in LapCode}
