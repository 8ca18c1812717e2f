"""Run folders: configs, plans, laps and results on disk, as YAML, JSON and netCDF."""

from driftjax.data.folder import RunFolder as RunFolder
from driftjax.data.folder import list_runs as list_runs
from driftjax.data.variables import PLAN as PLAN
from driftjax.data.variables import STAGE as STAGE
from driftjax.data.variables import code_names as code_names
from driftjax.data.variables import dataset as dataset
