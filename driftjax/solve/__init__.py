"""Solvers for optimal control: one problem, long horizons, batches; independent of cars."""

from driftjax.solve.batch import BatchSolution as BatchSolution
from driftjax.solve.batch import plain as plain
from driftjax.solve.batch import solve_batch as solve_batch
from driftjax.solve.batch_ocp import AbstractBatchOCP as AbstractBatchOCP
from driftjax.solve.filter_line_search import solve_with_filter as solve_with_filter
from driftjax.solve.ocp import AbstractOCP as AbstractOCP
from driftjax.solve.ocp import Options as Options
from driftjax.solve.ocp import Solution as Solution
from driftjax.solve.ocp import shift as shift
from driftjax.solve.one_problem import solve as solve
