"""driftjax: a differentiable, jit-compiled car in JAX that learns to drift."""

__version__ = "0.1.0"
