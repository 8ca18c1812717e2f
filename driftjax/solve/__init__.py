"""Solvers for optimal control: one problem, long horizons, batches; independent of cars."""

from driftjax.solve.filter_line_search import solve_with_filter as solve_with_filter
from driftjax.solve.implicit import solve as solve
from driftjax.solve.interior_point import shift as shift
from driftjax.solve.lane_ocp import AbstractLanes as AbstractLanes
from driftjax.solve.lanes import LanePlans as LanePlans
from driftjax.solve.lanes import solve_lanes as solve_lanes
from driftjax.solve.ocp import AbstractOCP as AbstractOCP
from driftjax.solve.ocp import Linear as Linear
from driftjax.solve.ocp import Options as Options
from driftjax.solve.ocp import Plan as Plan
