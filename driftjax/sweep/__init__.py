"""Sweeps: many trials of a verb over its options, kept as they come, wherever they run; knows no verb."""

from driftjax.sweep.config import SweepConfig as SweepConfig
from driftjax.sweep.config import load_sweep as load_sweep
from driftjax.sweep.engine import sweep as sweep
from driftjax.sweep.executors import executor as executor
from driftjax.sweep.source import Laid as Laid
from driftjax.sweep.source import check as check
from driftjax.sweep.store import Store as Store
from driftjax.sweep.trial import Work as Work
