"""Detect errors that no effect of the catalogue explains: generic terms in every rate, axle force and sensor.

After the search, errors that depend on one variable each (speed, sideslip, drive, time, heading, place ...) are put to
the same test as effects. What they explain beyond the named effects shows what is wrong and what it depends on.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import Control, State
from driftjax.diagnosis.fit import Problem, evaluate_fit, linearise
from driftjax.diagnosis.observer import Path, slip_angles
from driftjax.diagnosis.runs import Linearisation, whitened_derivatives
from driftjax.diagnosis.score import (
    CONDITION,
    Scores,
    half_widths_from,
    null_max_scores,
    partial_out,
    studentised_scores,
    sums_by_block,
)
from driftjax.diagnosis.select import LEVEL, PARAMETER_PENALTY, Selection
from driftjax.logs.columns import MEASURED
from driftjax.vehicle.single_track import G, SingleTrack
from driftjax.vehicle.universal import Universal

UNITS = {"rate": ("m/s^2", "rad/s", "rad/s^2"), "force": ("N", "N"), "sensor": ("m/s", "rad", "rad/s")}
CHANNELS = {"rate": MEASURED, "force": ("Fyf", "Fyr"), "sensor": MEASURED}  # that a term adds to
MIN_TERM_GAIN = 16.0  # required fall of the cost of a remaining term: terms are many
TERM_PENALTY = 5.0  # penalty per term when variables are compared


class Term(NamedTuple):
    """A generic error: `value` times a function of one variable, added to a rate, an axle force or a sensor."""

    channel: str  # V, beta or r, or the force Fyf or Fyr in the wheel frame
    where: str  # `rate`, `force` or `sensor`
    function: str  # dimensionless, such as `V^2/(gL)`
    value: float  # [unit]
    half_width: float  # of its 95 % interval, robust to dependence within blocks [unit]
    unit: str


class Unexplained(NamedTuple):
    """Errors that the named effects do not explain."""

    p_value: float  # that chance gives the largest score of all effects and generic terms left
    gain: float  # predicted fall of the cost with the best single term
    share: float  # of the fall by named effects and that term together: what the term would add, 1 where none is named
    variables: dict[str, float]  # explanatory, with the predicted fall of the cost, largest first
    term: Term  # that explains most by itself
    simpler: Term | None  # explains by itself as much as all effects named, of which there are several
    nominal_variables: dict[str, float]  # as `variables`, for all errors of the nominal car

    @property
    def significant(self) -> bool:
        """Return whether a significant error remains that justifies a parameter."""
        return self.p_value < LEVEL and self.gain > MIN_TERM_GAIN


class GenericTerms(NamedTuple):
    """Scores of the generic terms, with the effects of one hypothesis projected out."""

    kinds: list[tuple[str, str, str, int]]  # (n) variable, function, key of `CHANNELS`, channel
    U: np.ndarray  # (n,)
    F: np.ndarray  # (n, n) their information
    distinct: np.ndarray  # (n,) whether a term is distinguishable from the hypothesis
    e: np.ndarray  # (P, T, c) whitened innovations
    J: np.ndarray  # (P, T, c, K+n) their derivatives by all effects and terms
    P: np.ndarray  # (K+n, n) what takes the hypothesis out of those by the terms
    p_value: float  # that chance gives the largest score of terms and effects


def rate_functions(problem: Problem, path: Path) -> dict[str, dict[str, Array]]:
    """Return functions (P, T) of every variable along `path`, scaled to order one; keys give their formulas."""
    car, place = problem.model.base, problem.data.padded.place
    x, u = jnp.moveaxis(path.z[..., :3], -1, 0), jnp.moveaxis(path.u, -1, 0)
    angles = jax.vmap(jax.vmap(lambda x, u: slip_angles(problem.model, x, u)))
    front, rear = jnp.moveaxis(angles(path.z, path.u), -1, 0)
    V, r, push = x[0] / car.unit_speed, x[2] * car.unit_time, u[1] / (car.m * G)
    both = lambda name, value: {name: value, f"|{name}|": jnp.abs(value)}
    rate = lambda value: jnp.diff(value, axis=1, prepend=value[:, :1]) / problem.data.dt * car.unit_time
    turns = [(k, 2 * np.pi * k * place.s) for k in (1, 2)]
    selection = {
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
    return {
        name: terms for name, terms in selection.items() if name not in ("psi", "s") or name in problem.extra_columns
    }


def sensor_functions(problem: Problem, path: Path) -> dict[str, tuple[str, Array]]:
    """Return functions (P, T) for sensor errors, of the predicted state, which is independent of the sample's noise."""
    V, beta, r = jnp.moveaxis(path.predicted[..., :3], -1, 0)
    size = term_scales(problem.model)["sensor"]
    return {"1": ("1", jnp.ones_like(V)), "V": ("V/sqrt(gL)", V / size[0]), "beta": ("beta", beta),
            "r": ("r sqrt(L/g)", r / size[2])}  # fmt: skip


def find_unexplained(problem: Problem, selection: Selection, seed: int) -> Unexplained:
    """Test the errors that remain after the named effects, and rank the variables that explain them.

    Several effects that together lower the cost by no more than one generic term only imitate what the catalogue lacks.
    """
    remaining = generic_terms(problem, selection.linearisation, selection.scores, selection.selected, seed)
    base = selection.base
    of_nominal = (
        generic_terms(base, linearise(base, selection.nominal), selection.nominal_scores, (), seed)
        if selection.selected
        else remaining
    )
    gain, term = best_term(problem, remaining)
    fall, simpler = 0.0, None
    if selection.selected:
        fall = max(selection.nominal.cost - evaluate_fit(base, selection.fit.theta).cost, 0.0)
    if len(selection.selected) > 1:
        most, alone = best_term(problem, of_nominal)
        earned = fall - PARAMETER_PENALTY * len(base.columns(selection.selected))
        simpler = alone if most - PARAMETER_PENALTY >= earned else None
    share = gain / (gain + fall) if gain + fall else 0.0
    ranked = rank_variables(remaining), rank_variables(of_nominal)
    return Unexplained(remaining.p_value, gain, share, ranked[0], term, simpler, ranked[1])


def generic_terms(
    problem: Problem, linearisation: Linearisation, tested: Scores, selected: tuple[int, ...], seed: int
) -> GenericTerms:
    """Score the generic terms at the fit of the effects `selected`, with its `linearisation` and scores `tested`."""
    rates = [(v, *one) for v, terms in rate_functions(problem, linearisation.path).items() for one in terms.items()]
    sensors = [(v, *one) for v, one in sensor_functions(problem, linearisation.path).items()]
    kinds = [
        (v, name, where, channel) for functions, places in ((rates, ("rate", "force")), (sensors, ("sensor",)))
        for v, name, _ in functions for where in places for channel in range(len(CHANNELS[where]))
    ]  # fmt: skip
    J = _sensitivities(problem, linearisation, [value for *_, value in rates], [value for *_, value in sensors])
    K = len(problem.lower)
    further = np.asarray(linearisation.J).shape[2] - len(MEASURED)  # channels that no term acts on
    J = np.concatenate([np.asarray(linearisation.J), np.pad(J, ((0, 0), (0, 0), (0, further), (0, 0)))], axis=-1)
    H, blocks = sums_by_block(problem, linearisation.e, J)
    P = partial_out(H, problem.columns(selected))
    effective, information = blocks @ P, P.T @ H @ P
    own = np.diag(information) > CONDITION * np.diag(H)
    own[:K] &= tested.T != 0
    T = studentised_scores(effective, own)
    chance = null_max_scores(effective, own, np.zeros(len(T), bool), seed)
    p_value = (1 + np.sum(chance >= np.abs(T).max(initial=0.0))) / (len(chance) + 1)
    U, e = effective.sum(axis=0)[K:], np.asarray(linearisation.e)
    return GenericTerms(kinds, U, information[K:, K:], own[K:], e, J, P[:, K:], float(p_value))


def rank_variables(terms: GenericTerms) -> dict[str, float]:
    """Rank the variables by the predicted fall of the cost with their terms, the largest first."""
    names = list(dict.fromkeys(variable for variable, *_ in terms.kinds))
    among = lambda name: np.array([kind[0] in ("1", name) for kind in terms.kinds]) & terms.distinct
    each = {name: _penalised_gain(terms.U, terms.F, among(name)) for name in names}
    return dict(sorted(each.items(), key=lambda item: -item[1]))


def best_term(problem: Problem, terms: GenericTerms) -> tuple[float, Term]:
    """Return the largest fall of the cost that a single term is predicted to give, and that term."""
    information = np.diag(terms.F)
    gain = np.where(terms.distinct, terms.U**2 / np.where(terms.distinct, information, 1.0), 0.0)
    at = int(np.argmax(gain))
    _, function, where, channel = terms.kinds[at]
    size, unit = term_scales(problem.model)[where][channel], UNITS[where][channel]
    value, j = terms.U[at] / information[at], terms.J @ terms.P[:, at]
    H, blocks = sums_by_block(problem, terms.e - value * j, j[..., None])  # the scores of what the term itself leaves
    width = half_widths_from(H, blocks, np.array([0]))[0]
    return float(gain[at]), Term(
        CHANNELS[where][channel], where, function, float(value * size), float(width * size), unit
    )


def term_scales(model: Universal) -> dict[str, np.ndarray]:
    """Return the scales of rates (g, sqrt(g/L), g/L), axle forces (m g) and V, beta, r (sqrt(gL), 1, sqrt(g/L)), SI."""
    time, speed, weight = float(model.base.unit_time), float(model.base.unit_speed), float(model.base.m) * G
    return {"rate": np.array([G, 1 / time, 1 / time**2]), "force": np.full(2, weight),
            "sensor": np.array([speed, 1.0, 1 / time])}  # fmt: skip


def rates_of_forces(car: SingleTrack, path: Path) -> Array:
    """Return the change (P, T, 3, 2) of the rates of V, beta, r by the lateral forces of front and rear axle [1/N]."""

    def rates(force: Array, z: Array, u: Array) -> Array:
        return jnp.stack(car.rates(State(z[0], z[1], z[2]), Control(u[0], u[1]), force[0], force[1]))

    by_force = jax.vmap(jax.vmap(jax.jacfwd(rates), in_axes=(None, 0, 0)), in_axes=(None, 0, 0))
    return jax.jit(by_force)(jnp.zeros(2), jnp.asarray(path.z), jnp.asarray(path.u))


def _sensitivities(
    problem: Problem, linearisation: Linearisation, rates: list[Array], sensors: list[Array]
) -> np.ndarray:
    """Return whitened derivatives (P, T, 3, terms): by rates and axle forces, five per function (P, T), and sensors."""
    steps, size = linearisation.steps, term_scales(problem.model)
    by_force = np.asarray(rates_of_forces(problem.model.base.nominal, linearisation.path))
    force = np.asarray(steps.push) @ by_force * size["force"]
    push = np.concatenate([np.asarray(steps.push) * size["rate"], force], axis=-1)
    scaled = lambda by, functions: np.concatenate([by * np.asarray(f)[..., None, None] for f in functions], axis=-1)
    by_rates, readings = scaled(push, rates), scaled(np.diag(size["sensor"]), sensors)
    zeros = lambda like, num: np.zeros((*like.shape[:-1], num))
    C = np.concatenate([by_rates, zeros(by_rates, readings.shape[-1])], axis=-1)
    F = np.concatenate([zeros(readings, by_rates.shape[-1]), readings], axis=-1)
    terms = steps._replace(C=C, F=F, first=np.zeros_like(C[:, 0]))
    # in the program of the catalogue's own derivatives
    return np.asarray(whitened_derivatives(terms, problem.gains, problem.data, len(problem.lower)))


def _penalised_gain(U: np.ndarray, F: np.ndarray, which: np.ndarray) -> float:
    """Return the predicted fall of the cost with the terms `which` together, less a penalty per term."""
    if not which.any():
        return 0.0
    part, U = F[np.ix_(which, which)], U[which]
    size = np.sqrt(np.diag(part))
    part = part / np.outer(size, size) + 1e-6 * np.eye(len(U))
    return float(U / size @ np.linalg.solve(part, U / size) - TERM_PENALTY * len(U))
