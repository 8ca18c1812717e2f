"""driftjax: a differentiable, jit-compiled car in JAX that learns to drift."""

from driftjax.environment import setup as setup

__version__ = "0.1.0"

setup()
