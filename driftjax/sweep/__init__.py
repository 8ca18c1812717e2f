"""Sweeps: many trials of a verb over its options, stored as they end; knows no verb itself."""

from driftjax.sweep.config import SweepConfig as SweepConfig
from driftjax.sweep.config import load_sweep as load_sweep
from driftjax.sweep.engine import run_trials as run_trials
from driftjax.sweep.executors import open_executor as open_executor
from driftjax.sweep.run import OpenSweep as OpenSweep
from driftjax.sweep.run import SweepResult as SweepResult
from driftjax.sweep.run import finish_sweep as finish_sweep
from driftjax.sweep.run import open_sweep as open_sweep
from driftjax.sweep.source import check as check
from driftjax.sweep.trial import Work as Work
