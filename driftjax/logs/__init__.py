"""Measured logs: read tables and recordings, map columns, resample, check."""

from driftjax.logs.columns import CHANNELS as CHANNELS
from driftjax.logs.columns import ColumnMap as ColumnMap
from driftjax.logs.columns import load_columns as load_columns
from driftjax.logs.inspection import Inspection as Inspection
from driftjax.logs.inspection import inspect as inspect
from driftjax.logs.log import Log as Log
from driftjax.logs.log import Run as Run
from driftjax.logs.log import read_log as read_log
from driftjax.logs.log import write_log as write_log
