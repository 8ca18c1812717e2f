"""Stages of `driftjax learn`: drive one lap per batch entry, and update the model from it."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.learning.acquire import Acquired, acquire, candidate_grid
from driftjax.learning.arrival import planned_arrival
from driftjax.learning.config import LearnConfig
from driftjax.learning.explore import Candidates, candidates, choose, offset, remaining
from driftjax.learning.model import empty
from driftjax.learning.reference import AIM_POINTS, Aim, Planned
from driftjax.learning.scenario import Scenario, build_drivers
from driftjax.learning.stage import CODES, StageResult, gp_deviation, run_stage, stage_values
from driftjax.learning.updates import Progress, initial_progress, plan_reference, update_progress
from driftjax.sim import where_tree
from driftjax.store.variables import FEATURES, INPUTS, OUTPUTS, dataset
from driftjax.vehicle import Extended, Residual


def stage_names(config: LearnConfig) -> list[str]:
    """List all stages that a run may have, in order; GP laps end early where they converge.

    The `-best` stages drive each entry's best setting again with fresh noise: a lap selected for its low error is a
    biased estimate of the setting, a lap driven afterwards is not. Only they enter the summary, and nothing is learnt
    there.
    """
    names = ["pursuit", "lqr"] if config.compare else []
    names += ["paper"] if config.compare and "paper" not in config.controllers else []
    names += ["nominal"] + (["single-layer"] if config.compare else [])
    if not config.gpr_laps:
        return names
    names += [f"gpr-{k}" for k in range(1, config.gpr_laps + 1)] + ["gpr-best"]
    explore = [f"explore-{k}" for k in range(1, config.explore.num_laps + 1)]
    return names + explore + (["explore-best"] if explore else [])


def first_progress(scenario: Scenario) -> Progress:
    """Return the progress before the first stage."""
    batch, K = scenario.batch_size, scenario.config.explore.num_sets
    curve = jnp.zeros((batch, AIM_POINTS))
    sets = jnp.zeros((batch, K, AIM_POINTS))
    visited, one = jnp.ones((batch, K), bool), curve[:, 0]
    none = Candidates(curve, curve, curve, curve, curve, one, sets, sets[..., 0], visited, one)
    return initial_progress(scenario, none)


def drive_stage(scenario: Scenario, progress: Progress, name: str, number: int):
    """Drive stage `name` and return the progress and its dataset; None if the stage has nothing to drive."""
    kind = name.split("-")[0]
    if name.endswith("-best"):
        return _best(scenario, progress, name, number)
    if kind == "explore":
        return _explore(scenario, progress, number)
    if kind == "gpr":
        return None if bool(progress.converged) else _gpr(scenario, progress, number)
    initial = _initial_residual(scenario)
    if kind == "pursuit":
        plan = scenario.over_batch(scenario.table)
        return progress, _data(
            scenario, run_stage(scenario, build_drivers(scenario, kind, plan, initial), number), kind
        )
    if kind == "lqr":  # along the reference of the nominal MPC, with its weights
        planned = _nominal_reference(scenario, initial)
        stage = run_stage(scenario, build_drivers(scenario, kind, planned.table, initial), number)
        return progress, _data(scenario, stage, kind, planned=planned)
    if kind == "paper":  # the paper's own cost, nominal car: how often it fails is part of the comparison
        batch = tuple(dataclasses.replace(entry, controller="paper") for entry in scenario.batch)
        other, planned = dataclasses.replace(scenario, batch=batch), _nominal_reference(scenario, initial)
        stage = run_stage(other, build_drivers(other, "mpc", planned.table, initial), number)
        return progress, _data(other, stage, "mpc", planned=planned)
    if kind == "single":  # the GP in the MPC, the reference from the nominal car
        residual = progress.model_state.residual
        planned = _nominal_reference(scenario, initial)
        stage = run_stage(scenario, build_drivers(scenario, "mpc", planned.table, residual), number)
        return progress, _data(scenario, stage, "mpc", residual, planned=planned)
    stage, planned = drive_nominal(scenario, number)
    return update_progress(scenario, progress, stage, None, number), _data(
        scenario, stage, "mpc", initial, planned=planned
    )


def drive_nominal(scenario: Scenario, number: int) -> tuple[StageResult, Planned]:
    """Drive one lap per entry by the drift MPC before learning, and return it with the reference that it tracked."""
    initial = _initial_residual(scenario)
    planned = _nominal_reference(scenario, initial)
    dither = scenario.over_batch(scenario.amplitude(*scenario.config.excitation))
    return run_stage(scenario, build_drivers(scenario, "mpc", planned.table, initial, dither), number), planned


def _initial_residual(scenario: Scenario) -> Residual:
    """Return the residual of every entry before its first lap."""
    return scenario.over_batch(empty(scenario.config.gp, scenario.lags, scenario.nominal).residual)


def _layers(scenario: Scenario, residual: Residual) -> tuple[Residual, Residual]:
    """Return the residuals that the reference and the MPC use: without the GP, lags and parameters remain."""
    layers = scenario.config.layers
    without_gp = eqx.tree_at(lambda d: d.trust_factor, residual, jnp.zeros_like(residual.trust_factor))
    return (
        residual if layers in ("both", "reference") else without_gp,
        residual if layers in ("both", "mpc") else without_gp,
    )


def _nominal_reference(scenario: Scenario, initial: Residual) -> Planned:
    """Return the reference that the nominal car can drive; the planner's car may have more grip."""
    arrival = scenario.over_batch(planned_arrival(scenario.table, scenario.config.switch.lead))
    return plan_reference(scenario, initial, arrival)


def _gpr(scenario: Scenario, progress: Progress, number: int):
    """Drive one GP lap: reference and MPC use the learnt model, then it is updated."""
    known, residual = _layers(scenario, progress.model_state.residual)
    planned = plan_reference(scenario, known, progress.arrival)
    stage = run_stage(scenario, build_drivers(scenario, "mpc", planned.table, residual), number)
    before = progress.last_error
    progress = update_progress(scenario, progress, stage, residual, number)
    change = jnp.abs(before - progress.last_error) / progress.last_error
    progress = eqx.tree_at(lambda p: p.converged, progress, jnp.all(change < scenario.config.converged))
    return progress, _data(scenario, stage, "mpc", residual, planned=planned)


def _best(scenario: Scenario, progress: Progress, name: str, number: int):
    """Drive each entry's best setting again; before exploration, compute the V-sets from its lap."""
    if name == "explore-best" and not bool(progress.explored):
        return None
    best = progress.best
    stage = run_stage(scenario, build_drivers(scenario, "mpc", best.table, best.residual), number)
    if not scenario.config.explore.num_sets:
        return progress, _data(scenario, stage, "mpc", best.residual)
    if name == "gpr-best":
        known, _ = _layers(scenario, progress.model_state.residual)
        on_path = jnp.zeros_like(progress.candidates.aimed)
        planned = jnp.full(scenario.batch_size, scenario.corner.V_b)
        new_candidates = candidates(scenario, stage.laps.trace, known, on_path, planned, number)
        progress = eqx.tree_at(lambda p: p.candidates, progress, new_candidates)
    return progress, _data(scenario, stage, "mpc", best.residual, progress.candidates)


class _Proposal(eqx.Module):
    """Next lap of every entry (leading axis: batch)."""

    index: Array  # candidate, which sets the gain of the path's correction
    aim: Aim
    dither: Array  # (batch, 2) amplitude of the excitation [rad, N]
    left: Array  # whether the entry had a candidate left
    acquired: Acquired | None  # what was predicted, unless Algorithm 1 chose


def _propose(scenario: Scenario, progress: Progress, known: Residual, number: int) -> _Proposal:
    """Choose the next lap of every entry, by Algorithm 1 or by predicted errors."""
    proposed, options = progress.candidates, scenario.config.explore
    if options.acquisition == "paper":
        index, V_ep, left = choose(scenario, proposed, known)
        aimed = jnp.where(left[:, None], offset(scenario, proposed, index), proposed.aimed)
        same = jnp.ones(scenario.batch_size)
        aim = Aim(V_ep - scenario.corner.V_b, same, proposed.s, aimed)
        return _Proposal(index, aim, jnp.zeros((scenario.batch_size, 2)), left, None)
    # the path is corrected as in the other kinds: by 1/K after a better lap, then by more
    index = jnp.minimum(jnp.sum(proposed.visited, axis=1), options.num_sets - 1)
    aimed = offset(scenario, proposed, index)
    still = Aim(jnp.zeros_like(proposed.current), jnp.ones_like(proposed.current), proposed.s, aimed)
    plan = plan_reference(scenario, known, progress.arrival, still).table
    laps_left = stage_names(scenario.config).index("explore-best") - number - 1
    chosen = acquire(scenario, known, progress.arrival, plan, aimed, progress.best.error, laps_left, number)
    aim = Aim(chosen.V, chosen.beta, proposed.s, jnp.where(chosen.possible[:, None], aimed, proposed.aimed))
    return _Proposal(index, aim, chosen.dither, chosen.possible, chosen)


def _explore(scenario: Scenario, progress: Progress, number: int):
    """Drive one lap of exploration: choose, plan, drive, learn.

    None where every entry has driven all its sets, unless the number of laps is fixed.
    """
    candidates_before = progress.candidates
    known, residual = _layers(scenario, progress.model_state.residual)
    proposal = _propose(scenario, progress, known, number)
    left, aimed = proposal.left, proposal.aim.e
    if not bool(jnp.any(left)) and not scenario.config.explore.fixed_laps:
        return None
    planned = plan_reference(scenario, known, progress.arrival, proposal.aim)
    # an entry that has driven all its sets repeats its best
    best = progress.best.table, progress.best.residual
    table, used = eqx.filter_jit(where_tree)(left, (planned.table, residual), best)
    dither = jnp.where(left[:, None], proposal.dither, 0.0)
    stage = run_stage(scenario, build_drivers(scenario, "mpc", table, used, dither), number)
    before = progress.best.error
    progress = update_progress(scenario, progress, stage, used, number)
    better = progress.best.error < before
    known, _ = _layers(scenario, progress.model_state.residual)
    trace, current = stage.laps.trace, jnp.where(left, scenario.corner.V_b + proposal.aim.V, candidates_before.current)
    rest = remaining(scenario, candidates_before, proposal.index, aimed, current, better, trace, known, number)
    progress = eqx.tree_at(lambda p: (p.candidates, p.explored), progress, (rest, jnp.asarray(True)))
    return progress, _data(scenario, stage, "mpc", used, candidates_before, planned, proposal.acquired)


def _data(
    scenario: Scenario,
    stage: StageResult,
    kind: str,
    residual: Residual | None = None,
    proposed: Candidates | None = None,
    planned: Planned | None = None,
    acquired: Acquired | None = None,
):
    values = stage_values(scenario, stage, kind)
    if planned is not None:
        values |= {"reference_found": planned.converged, "reference_error": planned.error}
    if residual is not None:
        values |= {
            "gp_Z": residual.gp.Z,
            "gp_mask": residual.gp.mask,
            "gp_std": gp_deviation(residual, stage.laps.trace),
            "gate": residual.trust_factor,
            "lags": residual.lags,
        }
        values |= {"feature": np.array(FEATURES, object), "output": np.array(OUTPUTS, object)}
        values["input"] = np.array(INPUTS, object)
    if residual is not None and residual.tuning.shape[-1] and isinstance(car := scenario.nominal, Extended):
        values |= {"car_parameter": np.array(car.parameter_names, object)}
        values["tuned"] = car.scale * (car.theta + residual.tuning)
    if proposed is not None:
        widest = proposed.widest[:, None]
        values |= {f"vset_{name}": getattr(proposed, name) for name in ("s", "origin", "target", "V", "V_ep")}
        values |= {"vset_lower": proposed.origin - widest, "vset_upper": proposed.origin + widest}
    if acquired is not None:
        grid, assessed = candidate_grid(scenario), acquired.assessment
        values |= {"grid_V": scenario.corner.V_b + grid.V, "grid_beta": scenario.corner.beta * grid.beta}
        values |= {"grid_excited": jnp.any(grid.dither > 0, axis=1), "grid_chosen": acquired.index}
        values |= {f"grid_{name}": getattr(assessed, name) for name in assessed._fields}
        values["grid_drivable"] = acquired.drivable
    if kind == "pursuit":  # it does not depend on the controller: one block of entries suffices
        num = scenario.batch_size // len(scenario.config.controllers)
        values = {name: value if name == "t" else np.asarray(value)[:num] for name, value in values.items()}
    return dataset({name: np.asarray(value) for name, value in values.items()}, {"codes": CODES})
