"""Measured logs: read tables and recordings, map columns, resample, check."""

from driftjax.logs.guess import Guess as Guess
from driftjax.logs.guess import guess_columns as guess_columns
from driftjax.logs.inspection import inspect as inspect
from driftjax.logs.log import Log as Log
from driftjax.logs.log import Run as Run
from driftjax.logs.log import read_log as read_log
from driftjax.logs.log import write_log as write_log
