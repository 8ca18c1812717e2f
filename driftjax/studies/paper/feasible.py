"""Check whether a plant can drive the plan: the steady drift of the corner on the car learnt from each plant."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import RESULTS, Control, State, from_dict
from driftjax.equilibrium import SlipRadius, SpeedYaw, continuation
from driftjax.learning.config import LearnConfig
from driftjax.learning.run import read_progress
from driftjax.learning.scenario import build_scenario
from driftjax.parallel import BatchExecutor, call, vmap_batch
from driftjax.store import RunFolder
from driftjax.vehicle import AnyCar, Residual

STAGE = "gpr-best"


def feasible(run: RunFolder) -> dict[str, Any] | None:
    """Return per controller the share of plants with a drift at the planned V_b and r_b on nominal + GP.

    Also the speed of the drift at the planned sideslip and radius over V_b. None where the run has no GP laps.
    """
    if STAGE not in run.finished():
        return None
    config = from_dict(LearnConfig, run.config, str(run.path / "config.yaml"))
    scenario = build_scenario(config, BatchExecutor(1))
    residual = read_progress(scenario, run, STAGE).model_state.residual
    corner = scenario.corner
    planned = tuple(map(jnp.asarray, (corner.V_b, corner.r_b, corner.beta, corner.R)))
    guess, branch = (scenario.x_eq, scenario.u_eq), jnp.asarray(scenario.branch)
    exists, steady, speed = map(np.asarray, call(drift_exists, residual, scenario.nominal, planned, guess, branch))
    values: dict[str, Any] = {"V_b": float(corner.V_b), "r_b": float(corner.r_b)}
    for who in config.controllers:
        batch = np.array([entry.controller == who for entry in scenario.batch])
        ratio = speed[batch & steady] / corner.V_b
        ends = [float(f(ratio)) if len(ratio) else None for f in (np.mean, np.min, np.max)]
        values[who] = {"exists": float(exists[batch].mean()), "steady": float(steady[batch].mean()), "speed": ends}
    return values


def drift_exists(
    residual: Residual, nominal: AnyCar, planned: tuple[Array, ...], guess: tuple[State, Control], branch: Array
) -> tuple[Array, Array, Array]:
    """Return per batch entry whether a drift at (V_b, r_b) exists; whether one at (beta, R) does, and its speed."""
    V_b, r_b, beta, R = planned

    def one(d: Residual) -> tuple[Array, Array, Array]:
        fixed = continuation(nominal, d, SpeedYaw(V_b, r_b), guess, branch=branch)
        free = continuation(nominal, d, SlipRadius(beta, R), guess, branch=branch)
        return fixed.result == RESULTS.successful, free.result == RESULTS.successful, free.x.V

    return vmap_batch(one)(residual)
