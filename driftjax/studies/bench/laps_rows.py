"""Measure closed-loop laps with a learnt GP, many plants at once, by the code of `driftjax learn`."""

import dataclasses
import time
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from driftjax.control.driver import Driver
from driftjax.learning.config import LearnConfig, load_learn_config
from driftjax.learning.scenario import Scenario, build_drivers, build_scenario
from driftjax.learning.stage import run_stage
from driftjax.learning.stages import drive_nominal, first_progress
from driftjax.learning.updates import update_progress
from driftjax.parallel import BatchExecutor, CompileAheadExecutor, process_executor
from driftjax.sim import LapCode
from driftjax.studies.bench.config import BenchConfig
from driftjax.studies.bench.rows import PartResult, Row, Timing
from driftjax.vehicle import Residual

CAR = "sedan"


class Driven(NamedTuple):
    """Time and completion of the laps of one call."""

    seconds: float
    completed: float  # share


def lap_options(num: int) -> LearnConfig:
    """Return the options: one controller, `num` random plants, one noise seed each."""
    return dataclasses.replace(load_learn_config(CAR), plants=num, noise_seeds=1, controllers=("path",), compare=False)


def learnt_residual() -> Residual:
    """Return the residual learnt from one plant's nominal lap, on the host."""
    with process_executor(0, fused=True) as executor:
        scenario = build_scenario(lap_options(1), executor)
        stage, _ = drive_nominal(scenario, 0)
        progress = update_progress(scenario, first_progress(scenario), stage, None, 0)
    return jax.tree.map(lambda a: np.asarray(a)[0] if eqx.is_array(a) else a, progress.model_state.residual)


def time_laps(num: int, num_workers: int, residual: Residual) -> Driven:
    """Time a GP lap of `num` plants at once, with its program compiled before; workers then load it."""
    with process_executor(num_workers, fused=True) as executor:
        scenario, batch = build_laps(executor, num, residual)
        if executor.pool is None:
            run_stage(scenario, batch, 0)
        else:
            run_stage(dataclasses.replace(scenario, executor=CompileAheadExecutor(executor.pool)), batch, 0)
        start = time.perf_counter()
        stage = run_stage(scenario, batch, 1)
        jax.block_until_ready(stage.laps.code)
        seconds = time.perf_counter() - start
    return Driven(seconds, float(np.mean(np.asarray(stage.laps.code) == int(LapCode.COMPLETED))))


def build_laps(executor: BatchExecutor, num: int, residual: Residual) -> tuple[Scenario, Driver]:
    """Build scenario and drivers of `num` plants, all with the same residual."""
    scenario = build_scenario(lap_options(num), executor)
    return scenario, build_drivers(scenario, "mpc", *scenario.over_batch((scenario.table, residual)))


def measure_rows(cfg: BenchConfig) -> PartResult:
    """Compare the cost of a lap in a large batch with that of a single lap; each is driven once."""
    num = 2 if cfg.quick else cfg.batch
    on_cpu = jax.default_backend() == "cpu"
    num_workers = cfg.workers if on_cpu and cfg.workers > 1 else 0
    with jax.default_device(jax.devices("cpu")[0]):  # the peer is one core, also beside a GPU
        residual = learnt_residual()
        alone = time_laps(1, 0, residual)
    many = time_laps(num, num_workers, residual)
    where = f"with {max(1, num_workers)} processes" if on_cpu else f"in one call, {_peak_gigabytes():.3g} GB at most"
    words = f"{many.seconds:.3g} s in all {where}, {many.completed:.3g} of laps completed"
    facts = {"plants": num, "processes": max(1, num_workers), "seconds": many.seconds, "completed": many.completed,
             "remarks": words}  # fmt: skip
    what = f"GP lap in closed loop among {num} plants at once"
    return PartResult([Row("laps", what, "lap", Timing((many.seconds / num,)), "one lap alone, one core",
                         Timing((alone.seconds,)), "costs", facts=facts)])  # fmt: skip


def _peak_gigabytes() -> float:
    """Return the largest memory that arrays and programs took on the device so far [GB]."""
    return jax.devices()[0].memory_stats()["peak_bytes_in_use"] / 1e9
