"""Fit a Gaussian process to noisy samples; ask for mean, variance and gradient."""

import jax
import jax.numpy as jnp
import numpy as np

import driftjax as dj

rng = np.random.default_rng(0)
Z = rng.uniform(-2, 2, (80, 2))
gp = dj.fit_gp(Z, np.sin(2 * Z[:, 0]) + 0.1 * rng.standard_normal(80)).gp
at = jnp.array([[0.5, 0.0], [1.5, 0.0]])
print("mean", jax.vmap(gp.mean)(at)[:, 0], "truth", jnp.sin(2 * at[:, 0]))
print("variance", jax.vmap(gp.variance)(at)[:, 0], "gradient", gp.gradient(at[0])[0])
