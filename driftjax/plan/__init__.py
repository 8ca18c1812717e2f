"""The minimum-time planner: the fastest way along a track, with the declared drift of its tight corners."""

from driftjax.plan.config import PlanConfig as PlanConfig
from driftjax.plan.config import load_plan_config as load_plan_config
from driftjax.plan.planner import Plan as Plan
from driftjax.plan.planner import plan as plan
