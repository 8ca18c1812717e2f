"""Continue a steady state from the nominal car to a corrected one, scaling up a learnt residual or named effects."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from driftjax.core import RESULTS, Control, State
from driftjax.equilibrium.solve import (
    Equilibrium,
    Fixed,
    Model,
    SlipRadius,
    SpeedYaw,
    solve_equilibrium,
    solve_nominal,
)
from driftjax.vehicle import AnyCar, Corrected, Residual, SingleTrack
from driftjax.vehicle.single_track import G

NUM_STAGES = 8
LARGEST_JUMP = 0.25  # of an unknown from stage to stage; beyond it a root is not the continued one


class Scaled(eqx.Module):
    """A residual rate scaled by `eta`."""

    residual: Callable[[Array], Array]
    eta: Array

    def __call__(self, z: Array) -> Array:
        """Return eta d(z)."""
        return self.eta * self.residual(z)


def continuation(
    nominal: AnyCar,
    residual: Callable[[Array], Array],
    fixed: Fixed,
    guess: tuple[State, Control],
    *,
    branch: Array | int,
) -> Equilibrium:
    """Continue the steady state of `nominal` at `guess` through f + eta d to that of `nominal + residual`.

    Stops at the first failed stage: `eta` is how far it came, `result` why. `off_branch` also means a jump: a stage
    moved the unknowns (rad, force over weight, speed over sqrt(g R)) by more than `LARGEST_JUMP`, so that the root is
    not the continued one. Differentiable at eta = 1 like `solve_equilibrium`.
    """
    first = solve_equilibrium(nominal, nominal, fixed, guess, branch=branch)

    def part(eta: Array) -> tuple[Model, AnyCar]:
        car = residual.scaled(eta).tuned(nominal) if isinstance(residual, Residual) else nominal
        return Corrected(car, Scaled(residual, eta)), car

    return _follow(part, part(jnp.asarray(1.0)), fixed, first, branch)


def solve_steady(car: AnyCar, fixed: SpeedYaw | SlipRadius, *, branch: Array | int) -> Equilibrium:
    """Solve for the steady state of a car on `branch` without a guess; `no_root` if the published car has none.

    For an extended car it is continued from its nominal car while all effects grow, see `continuation`; each stage is
    judged by its own slip angles and peaks. At fixed speed and yaw rate drifts come in pairs that may merge and vanish
    on the way; at fixed sideslip they do not.
    """
    if isinstance(car, SingleTrack):
        return solve_nominal(car, fixed, branch=branch)

    def part(eta: Array) -> tuple[Model, AnyCar]:
        at = car.scaled(eta)
        return at, at

    return _follow(part, (car, car), fixed, solve_nominal(car.nominal, fixed, branch=branch), branch)


def _follow(
    part: Callable[[Array], tuple[Model, AnyCar]],
    last_part: tuple[Model, AnyCar],
    fixed: Fixed,
    first: Equilibrium,
    branch: Array | int,
) -> Equilibrium:
    """Continue `first` through `part(eta)`, a model and the car that classifies it, to `last_part` at eta = 1."""

    def stage(last: Equilibrium, eta: Array):
        new = solve_equilibrium(*part(eta), fixed, (last.x, last.u), branch=branch)
        new = eqx.tree_at(lambda e: e.eta, new, eta)
        new = eqx.tree_at(lambda e: e.result, new, _unless_jumped(last, new, fixed, last_part[1]))
        running = last.result == RESULTS.successful
        keep = lambda p, q: jnp.where(running, p, q)
        held = jax.tree.map(keep, new, last)
        steps = last.num_steps + jnp.where(running, new.num_steps, 0)
        return eqx.tree_at(lambda e: e.num_steps, held, steps), None

    first = eqx.tree_at(lambda e: e.eta, first, jnp.zeros_like(first.eta))
    etas = jnp.linspace(0.0, 1.0, NUM_STAGES + 1)[1:]
    followed, _ = jax.lax.scan(stage, jax.lax.stop_gradient(first), etas)
    # Once more at eta = 1, outside the scan and from the root itself, for the implicit gradient.
    last = solve_equilibrium(*last_part, fixed, (followed.x, followed.u), branch=branch)
    done = followed.result == RESULTS.successful
    return jax.tree.map(lambda p, q: jnp.where(done, p, q), last, jax.lax.stop_gradient(followed))


def _unless_jumped(last: Equilibrium, new: Equilibrium, fixed: Fixed, car: AnyCar) -> RESULTS:
    """Return the result of stage `new`, or `off_branch` where it lies far from `last`."""
    move = jnp.stack(
        [
            fixed.free(new.x) - fixed.free(last.x),
            new.u.delta - last.u.delta,
            (new.u.Fxr - last.u.Fxr) / (G * car.m),
        ]
    )
    jumped = (new.result == RESULTS.successful) & (jnp.max(jnp.abs(move)) > LARGEST_JUMP)
    return RESULTS.where(jumped, RESULTS.off_branch, new.result)  # pyright: ignore[reportArgumentType]
