"""Run folders: configs, plans, laps and results on disk, as YAML, JSON and netCDF."""

from driftjax.data.folder import RunFolder as RunFolder
from driftjax.data.folder import list_runs as list_runs
from driftjax.data.plan import plan_dataset as plan_dataset
from driftjax.data.plan import write_plan_csv as write_plan_csv
from driftjax.data.variables import PLAN as PLAN
from driftjax.data.variables import STAGE as STAGE
from driftjax.data.variables import code_names as code_names
from driftjax.data.variables import dataset as dataset
