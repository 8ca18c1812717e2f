"""Compile the programs of the experiment ahead of time: all stages without their computations, in the workers."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from driftjax.learning.scenario import Scenario
from driftjax.learning.stages import drive_stage, first_progress
from driftjax.parallel import CompileAheadExecutor

# Stages that between them need every program, in two rows of about equal work.
ROWS = (("nominal", "gpr-best"), ("pursuit", "lqr", "gpr-1", "explore-1"))


def compile_stages(scenario: Scenario, names: list[str], before_stage: Callable[[str], object]) -> None:
    """Compile the programs of the stages `names` in the workers; does nothing without workers."""
    if scenario.executor.pool is None:
        return
    dry = dataclasses.replace(scenario, executor=CompileAheadExecutor(scenario.executor.pool))

    def row(stages: tuple[str, ...]) -> None:
        progress = first_progress(dry)
        for name in filter(names.__contains__, stages):
            before_stage(name)
            driven = drive_stage(dry, progress, name, 0)
            progress = progress if driven is None else driven[0]

    with ThreadPoolExecutor(len(ROWS)) as rows:
        list(rows.map(row, ROWS))
