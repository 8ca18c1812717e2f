"""Steering compliance: delta = delta_0 - c F_yf(alpha_f), alpha_f = alpha_f0 + delta_0 - delta.

Solved for alpha_f by Newton's method, with the front side force at static load and nominal friction (Milliken and
Milliken 1995, Ch. 19).
"""

import jax
import jax.numpy as jnp

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow, tyre

STEPS = 3  # of Newton's method


def apply(flow: Flow, p) -> Flow:
    """Reduce the front steering angle by p times the front side force, solved for the slip angle that results."""
    front = tyre(flow.muf, flow.car.Bf, flow.car.Cf, flow.car.curve_f)
    force = lambda alpha: front.lateral(alpha, flow.Fzf)
    alpha = flow.alpha_f
    for _ in range(STEPS):
        Fyf, slope = jax.jvp(force, (alpha,), (jnp.ones_like(alpha),))
        alpha = alpha - (alpha - flow.alpha_f - p[0] * Fyf) / (1 - p[0] * slope)
    u = flow.u._replace(delta=flow.u.delta - (alpha - flow.alpha_f))
    return flow._replace(u=u, alpha_f=alpha)


EFFECT = Effect(
    name="steer_compliance",
    number=30,
    station="slip",
    parameters=(Parameter("c", "rad/N", 0.05, "per_force", lower=0.0),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 19",
    sentence="side force bends the steering back",
)
