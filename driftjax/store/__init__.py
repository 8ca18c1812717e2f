"""Run folders: configs, plans, laps and results on disk, and their variables."""

from driftjax.store.folder import RunFolder as RunFolder
from driftjax.store.folder import list_runs as list_runs
from driftjax.store.variables import DIAGNOSIS as DIAGNOSIS
from driftjax.store.variables import code_names as code_names
from driftjax.store.variables import dataset as dataset
