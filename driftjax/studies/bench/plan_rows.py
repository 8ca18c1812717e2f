"""Measure the minimum-time plan of the sedan on its shipped corner against IPOPT on the same transcription."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from driftjax.core import RESULTS
from driftjax.planner import PlanConfig, load_plan_config
from driftjax.planner.nodes import nodes
from driftjax.planner.planner import BARRIER, problem, solve_from
from driftjax.planner.problem import MinimumTime, Stage
from driftjax.planner.stages import guesses, stages
from driftjax.solve import Options, Solution
from driftjax.studies.bench.config import PEERS, BenchConfig, missing
from driftjax.studies.bench.rows import PartResult, RecordedCall, Row, alternate, timed
from driftjax.track import load_track
from driftjax.vehicle import VehicleConfig, load_vehicle

CAR = "sedan"
SIDE_BY_SIDE, COST_TARGET = 16, 3.0
FRICTION = 0.02  # by this share the friction of the cars side by side differs at most, either way


class Setting(NamedTuple):
    """Problem data of both sides."""

    vehicle: VehicleConfig
    config: PlanConfig
    stage: Stage
    ds: float
    guess: np.ndarray  # (n, 7) SI: gripping everywhere


def setting() -> Setting:
    """Return the problem data of the shipped options."""
    track, config = load_track(f"{CAR}_corner"), load_plan_config(CAR)
    vehicle = config.planned(load_vehicle(CAR))
    at = nodes(track, vehicle.a + vehicle.b, config)
    stage, corners = stages(track, vehicle, config, at.s)
    return Setting(vehicle, config, stage, at.s[1] - at.s[0], guesses(at.s, stage, corners, vehicle, config)[0])


def minimum_time_problem(of: Setting, mu: float = 1.0) -> MinimumTime:
    """Return this package's problem with `mu` times the friction."""
    vehicle = dataclasses.replace(of.vehicle, mu=mu * of.vehicle.mu)
    return problem(vehicle, of.config, of.stage, of.ds)


@eqx.filter_jit
def _solve(ocps: MinimumTime, stage: Stage, X: jax.Array, options: Options, entry_speed: jax.Array) -> Solution:
    """Solve problems with a leading axis from one guess `X` (n, 7) in SI."""

    def one(ocp: MinimumTime) -> Solution:
        x0 = jnp.zeros(7).at[0].set(entry_speed) / ocp.scale
        return solve_from(ocp, x0, stage, X / ocp.scale, options)

    return eqx.filter_vmap(one)(ocps)


def plan_solves(of: Setting, num: int) -> Callable[[], Solution]:
    """Return the plans of `num` cars at once, ready to run; a single car has the shipped friction."""
    share = np.linspace(-FRICTION, FRICTION, num) if num > 1 else np.zeros(1)
    each = [minimum_time_problem(of, 1 + float(more)) for more in share]
    stacked = jax.tree.map(lambda *a: jnp.stack(a) if eqx.is_array(a[0]) else a[0], *each)
    options = Options(of.config.tolerance, BARRIER, of.config.max_steps)
    guess, entry = jnp.asarray(of.guess), jnp.asarray(of.config.entry_speed)
    return lambda: _solve(stacked, of.stage, guess, options, entry)


def measure_rows(cfg: BenchConfig) -> PartResult:
    """Compare one plan with IPOPT's, and a batch of plans with one."""
    of = setting()
    one, many = RecordedCall(plan_solves(of, 1)), RecordedCall(plan_solves(of, 1 if cfg.quick else SIDE_BY_SIDE))
    runs = {"one": timed(one, 1), "many": timed(many, 1)}
    ocp, peer = minimum_time_problem(of), None
    if not missing("casadi"):
        from driftjax.studies.bench.casadi_plan import CasadiPlan

        theirs = CasadiPlan(of.vehicle, of.config, of.stage, of.ds, np.asarray(ocp.scale), True, of.config.tolerance)
        peer = RecordedCall(lambda: theirs.solve(of.guess))
        runs["ipopt"] = timed(peer, 1)
    times = alternate(cfg.repeats, runs)
    seconds = float(ocp.L0 / ocp.V0)  # per unit of our objective
    facts = _facts(one.last) | {"nodes": len(of.guess), "objective": float(one.last.cost[0]) * seconds}
    if peer is not None:
        apart = abs(facts["objective"] - peer.last.cost) / peer.last.cost
        facts |= {"solved_ipopt": float(peer.last.success), "cost_difference_ipopt": apart}
    what = f"minimum-time plan, {len(of.guess)} nodes, from one guess"
    num = len(many.last.cost)
    return PartResult([
        Row("plan", what, "plan", times["one"], PEERS["ipopt"], times.get("ipopt"), "faster", 1.0, missing("casadi"),
            facts),
        Row("plan", f"{num} plans side by side", "batch", times["many"], "one plan", times["one"], "costs", COST_TARGET,
            facts=_facts(many.last)),
    ])  # fmt: skip


def _facts(plans: Solution) -> dict[str, float]:
    """Return the share of plans solved to the tolerance, and the iterations of the slowest."""
    solved = np.asarray(plans.result == RESULTS.successful)
    return {"solved": float(solved.mean()), "iterations": int(np.max(np.asarray(plans.num_steps)))}
