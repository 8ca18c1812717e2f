"""`driftjax learn`: the paper's experiment from the first lap to the results, resumable after every stage."""

import io
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from driftjax.core import BadInput
from driftjax.data.folder import RunFolder
from driftjax.data.plan import plan_dataset
from driftjax.data.variables import FEATURES, dataset
from driftjax.learn.config import LearnConfig
from driftjax.learn.explore import POINTS, Candidates, candidates, choose, drifts
from driftjax.learn.loop import Progress, plan_reference, remember, start
from driftjax.learn.results import results
from driftjax.learn.scenario import Scenario, build, drivers
from driftjax.learn.stage import CODES, Stage, run_stage, stage_values
from driftjax.sim import keep_where
from driftjax.vehicle import Residual

Report = Callable[[str, int, int], None]


def stage_names(config: LearnConfig) -> list[str]:
    """All stages that a run may have, in order; GP laps end early where they converge."""
    names = ["pursuit", "lqr"] if config.compare else []
    names += ["nominal"] + (["single-layer"] if config.compare else [])
    names += [f"gpr-{k}" for k in range(1, config.gpr_laps + 1)]
    return names + [f"explore-{k}" for k in range(1, config.explore.num_sets + 1)]


def run(config: LearnConfig, folder: RunFolder, report: Report) -> dict[str, Any]:
    """Drive every stage that `folder` does not hold yet, and return (and write) its results.

    Deterministic: the same config gives the same laps, resumed or not.
    """
    names = stage_names(config)
    report("plan", 0, len(names) + 1)
    scenario = build(config)
    if not folder.has("plan.nc"):
        folder.write_dataset("plan.nc", plan_dataset(scenario.plan, scenario.track, config.car))
    progress, done = _resume(scenario, folder)
    for index, name in enumerate(names):
        report(name, index + 1, len(names) + 1)
        if name in done or (name.startswith("gpr") and bool(progress.converged)):
            continue
        driven = _stage(scenario, progress, name, index)
        if driven is None:
            break
        progress, data = driven
        folder.write_stage(name, data, _dump(progress))
    found = results(scenario, {name: folder.read_stage(name) for name in folder.finished()})
    folder.write_json("results", found)
    folder.collect()
    report("done", len(names) + 1, len(names) + 1)
    return found


def _blank(scenario: Scenario) -> Candidates:
    lanes, K = scenario.num_lanes, scenario.config.explore.num_sets
    curve = jnp.zeros((lanes, POINTS))
    return Candidates(curve, curve, curve, jnp.zeros((lanes, K, POINTS)), jnp.zeros((lanes, K)), jnp.ones((lanes, K), bool))


def _dump(progress: Progress) -> bytes:
    stream = io.BytesIO()
    eqx.tree_serialise_leaves(stream, progress)
    return stream.getvalue()


def _resume(scenario: Scenario, folder: RunFolder) -> tuple[Progress, list[str]]:
    progress, done = start(scenario, _blank(scenario)), folder.finished()
    if done:
        try:
            progress = eqx.tree_deserialise_leaves(io.BytesIO(folder.read_state(done[-1])), progress)
        except (RuntimeError, ValueError, EOFError) as error:
            raise BadInput(f"{folder.path}: the state of stage {done[-1]} cannot be read ({error}); start anew.") from None
    return progress, done


def _stage(scenario: Scenario, progress: Progress, name: str, number: int):
    """Progress after stage `name` and its dataset; None where no lane has anything left to explore."""
    nothing = scenario.over_lanes(jnp.zeros(()))
    untaught = eqx.tree_at(lambda d: d.gate, progress.memory.residual, jnp.zeros((scenario.num_lanes, 3)))
    plan = scenario.over_lanes(scenario.table)
    if name in ("pursuit", "lqr"):
        stage = run_stage(scenario, drivers(scenario, name, plan, untaught), number)
        return progress, _data(scenario, stage, name, None, None)
    if name == "single-layer":  # the GP in the MPC, the reference from the nominal car
        residual = progress.memory.residual
        stage = run_stage(scenario, drivers(scenario, "mpc", plan, residual), number)
        return progress, _data(scenario, stage, "mpc", residual, None)
    if name.startswith("explore"):
        return _explore(scenario, progress, number)
    residual = untaught if name == "nominal" else progress.memory.residual
    first = name == "nominal" and scenario.config.reference == "entry"  # the plan is the nominal car's own entry
    table = plan if first else plan_reference(scenario, residual, nothing)
    stage = run_stage(scenario, drivers(scenario, "mpc", table, residual), number)
    before = progress.last_error
    progress = remember(scenario, progress, stage, residual, number)
    if name.startswith("gpr"):
        change = jnp.abs(before - progress.last_error) / progress.last_error
        settled = jnp.all(change < scenario.config.converged)
        progress = eqx.tree_at(lambda p: p.converged, progress, settled)
    return progress, _data(scenario, stage, "mpc", residual, None)


def _explore(scenario: Scenario, progress: Progress, number: int):
    """One lap of Algorithm 1: choose, plan, drive, learn."""
    if not bool(jnp.any(progress.found.V_ep > 0)):  # the sets are made once, from the best GP laps
        best = run_stage(scenario, drivers(scenario, "mpc", progress.best.table, progress.best.residual), number + 500)
        found = candidates(scenario, best.laps.trace, progress.memory.residual)
        progress = eqx.tree_at(lambda p: p.found, progress, found)
    found, residual = progress.found, progress.memory.residual
    V_b = jnp.asarray(scenario.corner.V_b)
    chosen, V_ep, left = choose(drifts(scenario), V_b, scenario.config.explore, found, residual)
    if not bool(jnp.any(left)):
        return None
    table = plan_reference(scenario, residual, jnp.where(left, V_ep - V_b, 0.0))
    visited = found.visited | (jax.nn.one_hot(chosen, found.visited.shape[1], dtype=bool) & left[:, None])
    # a lane that has driven all its sets repeats its best
    table, used = keep_where(left, (table, residual), (progress.best.table, progress.best.residual))
    stage = run_stage(scenario, drivers(scenario, "mpc", table, used), number)
    progress = remember(scenario, progress, stage, used, number)
    progress = eqx.tree_at(lambda p: p.found.visited, progress, visited)
    return progress, _data(scenario, stage, "mpc", used, found)


def _data(scenario: Scenario, stage: Stage, kind: str, residual: Residual | None, found: Candidates | None):
    values = stage_values(scenario, stage, kind)
    if residual is not None:
        values |= {"gp_Z": np.asarray(residual.gp.Z), "gp_mask": np.asarray(residual.gp.mask)}
        values["feature"] = np.array(FEATURES, object)
    if found is not None:
        share = scenario.config.explore.gamma_share * scenario.corner.V_b
        values |= {"vset_s": found.s, "vset_origin": found.origin, "vset_target": found.target, "vset_V": found.V,
                   "vset_V_ep": found.V_ep, "vset_lower": found.origin - share, "vset_upper": found.origin + share}  # fmt: skip
    if kind != "mpc":  # these drivers do not depend on the controller: one block of lanes says it all
        num = scenario.num_lanes // len(scenario.config.controllers)
        values = {name: value if name == "t" else np.asarray(value)[:num] for name, value in values.items()}
    return dataset({name: np.asarray(value) for name, value in values.items()}, {"codes": CODES})

