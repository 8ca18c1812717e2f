"""Fit parameters of effects to the rows of one plant: the prior mean of its Gaussian process.

A GP with a zero mean learns from one lap what the rates are where the car was, but not how they change with state and
command, which its feedback ties together: its slopes there are the prior's. A few parameters of the tyres and the drive
have the right slopes from the first lap on. The prior mean is thus the car with these parameters, and the GP describes
what they leave (Rasmussen and Williams 2006, Sec. 2.7; Nguyen-Tuong and Peters 2010, Using model knowledge for learning
inverse dynamics).
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from driftjax.core import Control, State, rk4_step
from driftjax.learning.residual import residual_rate, slopes_by_parameters
from driftjax.vehicle import Extended

PRIOR = 1.5  # standard deviation of a parameter, in typical sizes
DEPENDENT = 10  # rows that count as one: smoothing and the model's own errors correlate neighbours
STEPS = 8  # of Gauss-Newton; the rates are nearly linear in the parameters
TINY = 1e-12  # keeps the variance of a residual positive


def left_over(
    nominal: Extended, tuning: Float[Array, "K"], Z: Float[Array, "N 5"], Y: Float[Array, "N 3"],
    mask: Bool[Array, "N"], dt: Array,
) -> Float[Array, "N 3"]:  # fmt: skip
    """Return the residual rates [SI/s] of the car with `tuning` added to its parameters, where `Y` are the nominal's.

    Both lead over a step `dt` [s] to the same state; 0 where `mask` is false.
    """
    car = nominal.with_parameters(nominal.theta + tuning)

    def one(z: Array, d: Array) -> Array:
        x, u = State(z[0], z[1], z[2]), Control(z[3], z[4])
        rate = State(d[0], d[1], d[2])
        after = rk4_step(lambda w: jax.tree.map(jnp.add, nominal(w, u), rate), x, dt)
        return residual_rate(car, x, u, after, dt)

    return jnp.where(mask[:, None], jax.vmap(one)(Z, Y), 0.0)


def tune_parameters(
    nominal: Extended, effects: tuple[str, ...], Z: Float[Array, "N 5"], Y: Float[Array, "N 3"],
    mask: Bool[Array, "N"], dt: Array,
) -> Float[Array, "K"]:  # fmt: skip
    """Return what to add to the parameters of `nominal` [typical sizes], zero but for `effects`.

    The maximum a posteriori of the residual rates `Y` at inputs `Z`, with their variance per output unknown and a
    normal prior around the present parameters, within the limits of the catalogue. Slopes are those at the start of a
    step, far less work than exact ones through it: near the optimum they need not lead to a lower value, so that a
    search that compares values (`minimise_batch`) would stop beside it.
    """
    free = nominal.columns(effects)
    low, high = (limit[free] for limit in nominal.limits - nominal.theta)
    num = jnp.maximum(jnp.sum(mask), 1)

    def full(values: Array) -> Array:
        return jnp.zeros_like(nominal.theta).at[free].set(values)

    def step(_, values: Array) -> Array:
        tuning = full(values)
        left = left_over(nominal, tuning, Z, Y, mask, dt)
        car = nominal.with_parameters(nominal.theta + tuning)
        slopes = jax.vmap(lambda z: slopes_by_parameters(car, z)[:, free])(Z)
        weight = 1 / (DEPENDENT * (jnp.sum(left**2, axis=0) / num + TINY))
        slopes = jnp.where(mask[:, None, None], slopes, 0.0)
        H = jnp.einsum("nkp,nkq,k->pq", slopes, slopes, weight) + jnp.eye(len(free)) / PRIOR**2
        g = jnp.einsum("nkp,nk,k->p", slopes, left, weight) - values / PRIOR**2
        return jnp.clip(values + jnp.linalg.solve(H, g), low, high)

    return full(jax.lax.fori_loop(0, STEPS, step, jnp.zeros(len(free))))
