"""From the nominal car to the corrected one: the learnt residual is switched on gradually."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from driftjax.core import RESULTS, Control, State
from driftjax.equilibrium.solve import ANY, Equilibrium, Fixed, solve
from driftjax.vehicle import Corrected, SingleTrack
from driftjax.vehicle.single_track import G


class Scaled(eqx.Module):
    """The share `eta` of a residual rate."""

    residual: Callable[[Array], Array]
    eta: Array

    def __call__(self, z: Array) -> Array:
        """eta d(z)."""
        return self.eta * self.residual(z)


def continuation(
    nominal: SingleTrack,
    residual: Callable[[Array], Array],
    fixed: Fixed,
    guess: tuple[State, Control],
    *,
    branch: Array | int = ANY,
    num_stages: int = 8,
    largest_jump: float = 0.25,
) -> Equilibrium:
    """Steady state of `nominal + residual`, followed from the root of `nominal` at `guess` through f + eta d.

    Stops at the first stage that fails and says so: `eta` is how far it came, `result` why. `off_branch` also
    means a jump: a stage moved the unknowns (rad, force over weight, speed over sqrt(g R)) by more than
    `largest_jump`, so that the root is not the continued one. Differentiable at eta = 1 like `solve`.
    """

    def stage(last: Equilibrium, eta: Array):
        car = Corrected(nominal, Scaled(residual, eta))
        new = solve(car, nominal, fixed, (last.x, last.u), branch=branch)
        new = eqx.tree_at(lambda e: e.eta, new, eta)
        new = eqx.tree_at(lambda e: e.result, new, _check(last, new))
        running = last.result == RESULTS.successful
        keep = lambda p, q: jnp.where(running, p, q)
        held = jax.tree.map(keep, new, last)
        steps = last.num_steps + jnp.where(running, new.num_steps, 0)
        return eqx.tree_at(lambda e: e.num_steps, held, steps), None

    def _check(last: Equilibrium, new: Equilibrium) -> RESULTS:
        move = jnp.stack(
            [
                fixed.free(new.x) - fixed.free(last.x),
                new.u.delta - last.u.delta,
                (new.u.Fxr - last.u.Fxr) / (G * nominal.m),
            ]
        )
        jumped = (new.result == RESULTS.successful) & (jnp.max(jnp.abs(move)) > largest_jump)
        return RESULTS.where(jumped, RESULTS.off_branch, new.result)  # pyright: ignore[reportArgumentType]

    first = solve(nominal, nominal, fixed, guess, branch=branch)
    first = eqx.tree_at(lambda e: e.eta, first, jnp.zeros_like(first.eta))
    etas = jnp.linspace(0.0, 1.0, num_stages + 1)[1:]
    followed, _ = jax.lax.scan(stage, jax.lax.stop_gradient(first), etas)
    # Once more at eta = 1, outside the scan and from the root itself, for the implicit gradient.
    last = solve(Corrected(nominal, residual), nominal, fixed, (followed.x, followed.u), branch=branch)
    done = followed.result == RESULTS.successful
    return jax.tree.map(lambda p, q: jnp.where(done, p, q), last, jax.lax.stop_gradient(followed))
