"""What no effect of the catalogue explains: generic terms in every rate, and the variables that drive them.

After the search, forces that depend on one variable each (speed, sideslip, drive, time, heading, place ...) are put to
the same test as effects. What they explain beside the effects named says which rate is wrong and what it depends on.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.data.columns import MEASURED
from driftjax.diagnose.fit import Problem
from driftjax.diagnose.observer import Path, Steps, pushed, slip_angles
from driftjax.diagnose.runs import chained
from driftjax.diagnose.score import CONDITION, largest_by_chance, partial_out, studentised, sums_by_block
from driftjax.diagnose.select import LEVEL, WORTH, Selection
from driftjax.vehicle.single_track import G
from driftjax.vehicle.universal import Universal

UNITS = ("m/s^2", "rad/s", "rad/s^2")  # of the rates of V, beta, r
PER_TERM = 5.0  # what a term must explain to count when variables are compared


class Term(NamedTuple):
    """A generic force: `value` times a function of one variable, added to one rate."""

    channel: str  # whose rate
    function: str  # dimensionless, such as `V^2/(gL)`
    value: float  # [unit]
    half_width: float  # of its 95 % interval [unit]
    unit: str


class Unexplained(NamedTuple):
    """What is left beside the effects named."""

    p_value: float  # that chance gives the largest score of all effects and generic terms left
    gain: float  # fall of the cost that the best single term promises
    drivers: dict[str, float]  # variables with the fall of the cost that their terms promise, the largest first
    term: Term  # that explains most by itself

    @property
    def found(self) -> bool:
        """Whether anything is left that chance hardly makes and that is worth a parameter."""
        return self.p_value < LEVEL and self.gain > WORTH


def basis(task: Problem, path: Path) -> dict[str, dict[str, Array]]:
    """Functions (P, T) of every variable along `path`, of order one on any car; keys say how each is written."""
    car, place = task.model.base, task.data.track.place
    x, u = jnp.moveaxis(path.z[..., :3], -1, 0), jnp.moveaxis(path.u, -1, 0)
    angles = jax.vmap(jax.vmap(lambda x, u: slip_angles(task.model, x, u)))
    front, rear = jnp.moveaxis(angles(path.z, path.u), -1, 0)
    V, r, push = x[0] / car.unit_speed, x[2] * car.unit_time, u[1] / (car.m * G)
    both = lambda name, value: {name: value, f"|{name}|": jnp.abs(value)}
    rate = lambda value: jnp.diff(value, axis=1, prepend=value[:, :1]) / task.data.dt * car.unit_time
    turns = [(k, 2 * np.pi * k * place.s) for k in (1, 2)]
    found = {
        "1": {"1": jnp.ones_like(V)},
        "V": {"V/sqrt(gL)": V, "V^2/(gL)": V**2},
        "beta": both("beta", x[1]),
        "r": both("r sqrt(L/g)", r),
        "delta": both("delta", u[0]),
        "Fxr": both("Fxr/(mg)", push),
        "alpha_f": both("alpha_f", front),
        "alpha_r": both("alpha_r", rear),
        "ay": both("V r/g", V * r),
        "delta_rate": {"sqrt(L/g) d delta/dt": rate(u[0])},
        "Fxr_rate": {"sqrt(L/g) d Fxr/dt/(mg)": rate(push)},
        "t": {"t/(60 s)": place.t / 60.0},
        "heat": {"sliding work": place.heat},
        "psi": {"cos(psi)": jnp.cos(place.psi), "sin(psi)": jnp.sin(place.psi)},
        "s": {f"{f.__name__}({2 * k} pi s/lap)": f(angle) for k, angle in turns for f in (jnp.cos, jnp.sin)},
    }
    return {name: terms for name, terms in found.items() if name not in ("psi", "s") or name in task.has}


def unexplained(task: Problem, found: Selection, seed: int) -> Unexplained:
    """The test of all that the effects named leave, and what drives it."""
    functions = basis(task, found.at.path)
    variable = [name for name, terms in functions.items() for _ in terms for _ in MEASURED]
    written = [one for terms in functions.values() for one in terms for _ in MEASURED]
    J = _sensitivities(task, found.at.steps, [one for terms in functions.values() for one in terms.values()])
    K = len(task.lower)
    H, blocks = sums_by_block(task, found.at.e, np.concatenate([np.asarray(found.at.J), J], axis=-1))
    P = partial_out(H, task.columns(found.members))
    effective, information = blocks @ P, P.T @ H @ P
    own = np.diag(information) > CONDITION * np.diag(H)
    own[:K] &= found.scores.T != 0
    T = studentised(effective, own)
    chance = largest_by_chance(effective, own, np.zeros(len(T), bool), seed)
    p_value = (1 + np.sum(chance >= np.abs(T).max(initial=0.0))) / (len(chance) + 1)
    U, F, own = effective.sum(axis=0)[K:], information[K:, K:], own[K:]
    drivers = {name: _worth(U, F, np.array([v in ("1", name) for v in variable]) & own) for name in functions}
    best = int(np.argmax(np.where(own, U**2 / np.where(own, np.diag(F), 1.0), 0.0)))
    channel = MEASURED[best % len(MEASURED)]
    size, unit = _unit(task.model)[best % len(MEASURED)], UNITS[best % len(MEASURED)]
    value, width = U[best] / F[best, best], 1.96 / np.sqrt(F[best, best])
    term = Term(channel, written[best], float(value * size), float(width * size), unit)
    order = dict(sorted(drivers.items(), key=lambda item: -item[1]))
    return Unexplained(float(p_value), float(U[best] ** 2 / F[best, best]), order, term)


def _unit(model: Universal) -> np.ndarray:
    """Size of the rates of V, beta, r, SI: g, sqrt(g/L), g/L."""
    time = float(model.base.unit_time)
    return np.array([G, 1 / time, 1 / time**2])


def _sensitivities(task: Problem, steps: Steps, functions: list[Array]) -> np.ndarray:
    """Whitened derivatives (P, T, 3, terms) of the predictions by terms, three of each function."""
    push = jax.vmap(pushed, (0, None))(steps, task.data.dt) * jnp.asarray(_unit(task.model))
    C = jnp.concatenate([push * one[..., None, None] for one in functions], axis=-1)
    nothing = jnp.zeros_like(C[:, 0])
    terms = steps._replace(C=C, F=jnp.zeros_like(C[..., :3, :]), first=nothing)
    return np.asarray(chained(terms, task.data, task.gains))


def _worth(U: np.ndarray, F: np.ndarray, which: np.ndarray) -> float:
    """Fall of the cost that the terms `which` promise together, less what their number costs."""
    if not which.any():
        return 0.0
    part, U = F[np.ix_(which, which)], U[which]
    size = np.sqrt(np.diag(part))
    part = part / np.outer(size, size) + 1e-6 * np.eye(len(U))
    return float(U / size @ np.linalg.solve(part, U / size) - PER_TERM * len(U))
