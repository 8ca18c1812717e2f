"""The minimum-time planner: the fastest way along a track, with a declared drift in its tight corners."""

from driftjax.planner.config import PlanConfig as PlanConfig
from driftjax.planner.config import load_plan_config as load_plan_config
from driftjax.planner.planner import Plan as Plan
from driftjax.planner.planner import plan as plan
