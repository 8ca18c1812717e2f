"""Drive closed-loop laps of selected plants at given parameters, in parallel processes."""

import dataclasses
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.control.driver import Driver
from driftjax.control.table import ReferenceTable
from driftjax.gp import zero_gp
from driftjax.learning.metrics import LapFigures
from driftjax.learning.scenario import Scenario, build_drivers
from driftjax.learning.stage import drive_batch
from driftjax.parallel import concatenate
from driftjax.sim import LapCode, Trace
from driftjax.tune.config import Scales, TuneConfig
from driftjax.tune.loss import LapGradients, gradients_batch, lap_errors, lap_loss
from driftjax.tune.parameters import scaled_drivers
from driftjax.vehicle import no_residual


class LapResults(NamedTuple):
    """Laps with the hard switch: points K, plants L."""

    loss: Float[np.ndarray, "K L"]
    code: np.ndarray
    figures: LapFigures


@dataclasses.dataclass(frozen=True)
class LapEvaluator:
    """All plants of a run on its track."""

    config: TuneConfig
    scenario: Scenario

    @cached_property
    def untuned_drivers(self) -> Driver:
        """Return the drivers of all plants before tuning."""
        scenario = self.scenario
        initial = scenario.over_batch(no_residual(zero_gp(1, 5, 3), scenario.lags))
        return build_drivers(scenario, "mpc", scenario.over_batch(scenario.table), initial)

    @cached_property
    def plants(self) -> list[str]:
        """Return the names of the plants: the training plants, then the held-out ones."""
        return [entry.plant for entry in self.scenario.batch]

    def batch(self, p: Float[np.ndarray, " 6"], which: slice):
        """Return the batch of the plants `which` at `p`."""
        scenario = self.scenario
        speed = jnp.full(scenario.batch_size, scenario.plan.V[0])
        every = (scaled_drivers(self.untuned_drivers, jnp.asarray(p)), scenario.plants, speed, scenario.keys)
        return jax.tree.map(lambda a: a[which] if eqx.is_array(a) else a, every)

    def drive(self, points: Float[np.ndarray, "K 6"], which: slice) -> LapResults:
        """Drive a lap of each plant `which` at each of `points`."""
        learn = self.scenario.config
        each = [self.batch(p, which) for p in points]
        batch = concatenate(*each)
        trace, code, _, figures = self.scenario.executor.map(
            drive_batch, batch, self.scenario.sensors, learn.lap, learn.mpc.dt
        )
        loss = _losses(trace, code, batch[0].table, self.config.scales)
        plain: Any = jax.tree.map(lambda a: np.asarray(a).reshape(len(points), -1), (loss, code, figures))
        return LapResults(*plain)

    def gradients(self, p: Float[np.ndarray, " 6"], which: slice) -> LapGradients:
        """Return the derivatives at `p` of the laps of the plants `which` with the smooth switch."""
        learn = self.scenario.config
        shared = (self.scenario.sensors, learn.lap, learn.mpc.dt, self.config.scales, self.config.blend)
        gradients = self.scenario.executor.map(gradients_batch, self.batch(p, which), *shared)
        return jax.tree.map(np.asarray, gradients)


@eqx.filter_jit  # once for all points that are tried
def _losses(trace: Trace, code: Array, table: ReferenceTable, scales: Scales) -> Array:
    return jax.vmap(lambda t, c, row: lap_loss(lap_errors(t, row, scales), c, scales))(trace, code, table)


def lap_outcome(code: int) -> str:
    """Name how a lap ended."""
    return LapCode(code).name.lower().replace("_", " ")
