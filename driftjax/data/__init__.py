"""What is on disk: run folders with configs, plans, laps and results, and measured logs."""

from driftjax.data.columns import CHANNELS as CHANNELS
from driftjax.data.columns import ColumnMap as ColumnMap
from driftjax.data.columns import load_columns as load_columns
from driftjax.data.folder import RunFolder as RunFolder
from driftjax.data.folder import list_runs as list_runs
from driftjax.data.log import Log as Log
from driftjax.data.log import Run as Run
from driftjax.data.log import read_log as read_log
from driftjax.data.log import write_log as write_log
from driftjax.data.plan import plan_dataset as plan_dataset
from driftjax.data.plan import write_plan_csv as write_plan_csv
from driftjax.data.variables import DIAGNOSIS as DIAGNOSIS
from driftjax.data.variables import PLAN as PLAN
from driftjax.data.variables import STAGE as STAGE
from driftjax.data.variables import code_names as code_names
from driftjax.data.variables import dataset as dataset
