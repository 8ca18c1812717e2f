"""driftjax: a differentiable, jit-compiled car in JAX that learns to drift."""

__version__ = "0.1.0"

# XLA's flag for programs that round alike on any number of threads: loops cut into parts for them round otherwise.
WHOLE_LOOPS = "--xla_disable_hlo_passes=cpu-parallel-task-assigner"
