"""Fit a Gaussian process to noisy samples, by a shipped kernel and one of your own: mean, variance and gradient."""

import jax
import jax.numpy as jnp
import numpy as np

import driftjax as dj

rng = np.random.default_rng(0)
Z = rng.uniform(-2, 2, (80, 2))
y = np.sin(2 * Z[:, 0]) + 0.1 * rng.standard_normal(80)
gp = dj.fit_gp(Z, y).gp
at = jnp.array([[0.5, 0.0], [1.5, 0.0]])
print("mean", jax.vmap(gp.mean)(at)[:, 0], "truth", jnp.sin(2 * at[:, 0]))
print("variance", jax.vmap(gp.variance)(at)[:, 0], "gradient", gp.gradient(at[0])[0])
wave = lambda p, a, b: jnp.exp(-2 * jnp.sum(jnp.sin(p["rate"] * (a - b)[0] / 2) ** 2) / p["length"] ** 2)  # periodic
bounds = {"rate": 1.0, "length": 0.3}, {"rate": 4.0, "length": 10.0}
own = dj.fit_kernel(wave, Z, y, *bounds, key=jax.random.key(0))
print("own kernel:", own.parameters, "mean", jax.vmap(own.mean)(at), "variance", jax.vmap(own.variance)(at))
