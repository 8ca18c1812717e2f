"""Export a car to the formats of other tools, and report the effects that they cannot represent."""

from driftjax.export.controller import export_mpc as export_mpc
from driftjax.export.export import FORMATS as FORMATS
from driftjax.export.export import Export as Export
from driftjax.export.export import export_car as export_car
from driftjax.export.export import require_format as require_format
