"""Batched sequential quadratic programming for optimal control; knows no cars."""

from driftjax.solve.interior_point import shift as shift
from driftjax.solve.interior_point import solve as solve
from driftjax.solve.ocp import AbstractOCP as AbstractOCP
from driftjax.solve.ocp import Options as Options
from driftjax.solve.ocp import Plan as Plan
