"""Learning updates (Section V-A): start, update of model and best lap of each entry, reference planning."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from driftjax.control.mpc import DriftOCP
from driftjax.control.table import ReferenceTable
from driftjax.core import RESULTS, as_float
from driftjax.equilibrium import SlipRadius, continuation
from driftjax.learning.arrival import Arrival, planned_arrival, update_arrival
from driftjax.learning.config import GPConfig
from driftjax.learning.explore import Candidates
from driftjax.learning.model import ModelState, empty, update_model
from driftjax.learning.reference import Aim, Planned, entry_table, no_aim, step_table
from driftjax.learning.residual import acting_commands, estimate_lags, known_effect_basis, rows, samples
from driftjax.learning.scenario import LEARNING, Scenario, entry_problems
from driftjax.learning.stage import StageResult
from driftjax.parallel import vmap_batch
from driftjax.sim import Trace, where_tree
from driftjax.solve import Options
from driftjax.vehicle import AnyCar, Residual

# The entry problem has four times the MPC's horizon and starts from the plan, which its car cannot drive.
ENTRY_BARRIER, ENTRY_STEPS = 1.0, 150


class Best(eqx.Module):
    """Model and reference of each entry's best lap so far (leading axis: batch)."""

    error: Array  # mean measured lateral error, infinite before the first completed lap [m]
    residual: Residual
    table: ReferenceTable


class Progress(eqx.Module):
    """State passed from one stage to the next, sufficient to resume a stopped run."""

    model_state: ModelState
    arrival: Arrival  # of each entry
    best: Best
    last_error: Array  # measured, of the stage before, per entry [m]
    converged: Array  # bool: GP laps have converged
    candidates: Candidates
    explored: Array  # bool: at least one exploration lap was driven


def initial_progress(scenario: Scenario, empty_candidates: Candidates) -> Progress:
    """Return the progress before the first lap."""
    model_state = scenario.over_batch(empty(scenario.config.gp, scenario.lags, scenario.nominal))
    table = scenario.over_batch(scenario.table)
    arrival = scenario.over_batch(planned_arrival(scenario.table, scenario.config.switch.lead))
    far = jnp.full(scenario.batch_size, jnp.inf)
    no = jnp.asarray(False)
    return Progress(model_state, arrival, Best(far, model_state.residual, table), far, no, empty_candidates, no)


def learn_batch(
    batch: tuple[ModelState, Arrival, Trace, ReferenceTable, Array],
    nominal: AnyCar,
    dt: Array,
    lead: Array,
    shortest: Array,
    delay: Array,
    config: GPConfig,
) -> tuple[ModelState, Arrival]:
    """Update models and arrivals of batch entries (both before, lap, its reference, keys)."""
    known_basis = known_effect_basis(nominal, config.effects) if config.orthogonal else None

    def one(model_state: ModelState, arrival: Arrival, trace: Trace, table: ReferenceTable, key: Array):
        command = acting_commands(trace, delay, dt)
        lap = samples(trace, command)
        lags = estimate_lags(nominal, lap, dt) if config.lags else model_state.residual.lags
        model_state = update_model(
            model_state, *rows(nominal, lap, dt, lags), lags, config, key, known_basis, shortest, (nominal, dt)
        )
        s0, lags = table.drift_start - lead, model_state.residual.lags
        return model_state, update_arrival(arrival, trace, command, s0, lags, dt)

    return vmap_batch(one)(*batch)


def update_progress(
    scenario: Scenario, progress: Progress, stage: StageResult, residual: Residual | None, number: int
) -> Progress:
    """Update `progress` after a lap: learn from it and, unless `residual` is None, update the best laps.

    Laps are compared by their measured lateral error, as a real car has no other.
    """
    keys = jax.vmap(lambda key: jax.random.fold_in(key, LEARNING + number))(scenario.keys)
    batch = (progress.model_state, progress.arrival, stage.laps.trace, stage.table, keys)
    config = scenario.config
    numbers = (as_float(number) for number in
               (config.mpc.dt, config.switch.lead, config.gp.shortest, scenario.sensors.delay))  # fmt: skip
    model_state, arrival = scenario.executor.map(learn_batch, batch, scenario.nominal, *numbers, config.gp.program)
    arrival = arrival if config.measured_arrival else progress.arrival
    best = progress.best
    if residual is not None:
        error = jnp.where(stage.figures.completed, stage.figures.lateral_error_measured, jnp.inf)
        best = eqx.filter_jit(where_tree)(error < best.error, Best(error, residual, stage.table), best)
    last = stage.figures.lateral_error_measured
    fields = lambda p: (p.model_state, p.arrival, p.best, p.last_error)
    return eqx.tree_at(fields, progress, (model_state, arrival, best, last))


def plan_reference(scenario: Scenario, residual: Residual, arrival: Arrival, aim: Aim | None = None) -> Planned:
    """Plan the reference of every entry for its corrected car, with exploration targets `aim` (batch).

    `entry` replans the corner on nominal + GP; `step` is the paper's equilibrium at the shifted speed.
    """
    config = scenario.config
    aims: Aim = scenario.over_batch(no_aim(scenario.table)) if aim is None else aim
    if config.reference == "entry":
        ocp = entry_problems(scenario, residual)
        return scenario.executor.map(
            entry_table_batch,
            (ocp, arrival, aims),
            scenario.table,
            as_float(config.switch.lead),
            as_float(config.mpc.tolerance),
        )
    corner = scenario.corner
    fixed = SlipRadius(jnp.asarray(corner.beta), jnp.asarray(corner.R))
    guess = (scenario.x_eq, scenario.u_eq)
    return _steps(scenario.nominal, residual, fixed, guess, jnp.asarray(scenario.branch), scenario.table, aims.V)


def entry_table_batch(
    batch: tuple[DriftOCP, Arrival, Aim], table: ReferenceTable, lead: Array, tolerance: Array
) -> Planned:
    """Plan the corner for batch entries (problem, arrival, target)."""
    options = Options(tolerance, ENTRY_BARRIER, ENTRY_STEPS)
    return vmap_batch(lambda o, initial_progress, aim: entry_table(o, table, initial_progress, lead, aim, options))(
        *batch
    )


@eqx.filter_jit
def _steps(
    nominal, residual: Residual, fixed: SlipRadius, guess, branch: Array, table: ReferenceTable, V_shift: Array
) -> Planned:  # fmt: skip
    def one(d: Residual, shift: Array) -> Planned:
        equilibrium = continuation(nominal, d, fixed, guess, branch=branch)
        # r_b and beta_eq stay where V is explored: the same corner at another speed (Wu et al. 2025, Sec. IV-C)
        step = step_table(table, equilibrium.x._replace(V=equilibrium.x.V + shift), equilibrium.u)
        return Planned(step, equilibrium.result == RESULTS.successful, equilibrium.residual, equilibrium.num_steps)

    return vmap_batch(one)(residual, V_shift)
