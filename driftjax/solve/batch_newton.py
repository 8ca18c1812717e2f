"""Newton system of the quadratic programs of a batch, slacks and duals eliminated: Riccati sweeps over the stages."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from driftjax.solve.batch_conditions import (
    QPModel,
    bound_constraints,
    filled,
    split_by_kind,
    terms_of,
)
from driftjax.solve.batch_ocp import AbstractBatchOCP, Components
from driftjax.solve.component_derivatives import Entry, Matrix, column, dot, times, total
from driftjax.solve.compute_once import compute_once
from driftjax.solve.riccati_componentwise import (
    CostGradient,
    CostHessian,
    StageFactors,
    StageSystem,
    StageTerms,
    factor_stage,
    forward_stage,
    gradient_stage,
)


class NewtonSystem(NamedTuple):
    """Matrices of the Newton system; entries (N, batch)."""

    stages: StageSystem
    state: list[Entry]  # second derivatives in the state after each stage, of its limits
    end: Matrix  # in the last state, of the terminal cost (batch,)


class NewtonTerms(NamedTuple):
    """Right-hand side of the Newton system."""

    stages: StageTerms
    state: list[Entry]  # first derivatives in the state after each stage, of its limits
    end: list[Entry]  # in the last state, of the terminal cost (batch,)


class StepGains(NamedTuple):
    """Feedback of the steps of the inputs; entries (N, batch)."""

    x: Matrix  # on the step of the state
    u: Matrix  # on the step of the input before


def no_gains(X: Components, U: Components) -> StepGains:
    """Return gains of zero."""
    blank = lambda n: [[jnp.zeros_like(u) for _ in range(n)] for u in U]
    return StepGains(blank(len(X)), blank(len(U)))


class BackwardPass(NamedTuple):
    """Result of the backward sweep for one right-hand side."""

    k: Components  # constant parts of the steps of the inputs
    p: Components  # gradients of the cost-to-go after each stage
    c: Components  # defects


def newton_system(ocp: AbstractBatchOCP, model: QPModel, stiff: Components) -> NewtonSystem:
    """Build the system from a model and the second derivatives `stiff` of the limits' barrier in their values."""
    gaps, nx, nu = bound_constraints(ocp), len(model.c), len(model.h) - len(model.c)
    weight, like = ocp.rate_weight() or [0.0] * nu, model.c[0]
    bounds, stage, end = split_by_kind(model, stiff)
    of = lambda family, i: terms_of(gaps, family, i, bounds)
    both = lambda G, i, j, stiff: total(times(w, row[i], row[j]) for w, row in zip(stiff, G, strict=True))
    H = [[total((model.H[i][j], both(model.G, i, j, stage), *(of("input", i - nx) if i == j >= nx else ())))
          for j in range(nx + nu)] for i in range(nx + nu)]  # fmt: skip
    HN = [[total((model.HN[i][j], both(model.GN, i, j, end))) for j in range(nx)] for i in range(nx)]
    rate = [total((2 * weight[l] + jnp.zeros_like(like), *of("change", l))) for l in range(nu)]
    stages = StageSystem([row[:nx] for row in model.M], [row[nx:] for row in model.M], H, rate)
    state = [total(of("state", i)) for i in range(nx)]
    stages, state = _wide((stages, state), like)
    return NewtonSystem(stages, state, HN)


def newton_terms(ocp: AbstractBatchOCP, model: QPModel, of_changes: Components, push: Components) -> NewtonTerms:
    """Build the right-hand side from first derivatives: of a model, of the cost of changes, `push` of the barrier."""
    gaps, nx = bound_constraints(ocp), len(model.c)
    bounds, stage, end = split_by_kind(model, push)
    signed = [gap.sign * p for gap, p in zip(gaps, bounds, strict=True)]
    of = lambda family, i: terms_of(gaps, family, i, signed)
    h = [total((h, dot(column(model.G, i), stage), *(of("input", i - nx) if i >= nx else ())))
         for i, h in enumerate(model.h)]  # fmt: skip
    hN = [total((h, dot(column(model.GN, i), end))) for i, h in enumerate(model.hN)]
    pull = [total((g, *of("change", l))) for l, g in enumerate(of_changes)]
    state = [total(of("state", i)) for i in range(nx)]
    stages = StageTerms(list(model.c), h, pull)
    stages, state = _wide((stages, state), model.c[0])
    return NewtonTerms(stages, state, hN)


def _wide(entries, like: Array):
    return jax.tree.map(lambda e: jnp.broadcast_to(e, like.shape), entries)


def solve_backward(system: NewtonSystem, terms: NewtonTerms) -> tuple[StageFactors, BackwardPass]:
    """Factorise the system and run the backward sweep for one right-hand side."""
    zero = jnp.zeros_like(terms.stages.c[0][0])
    nx, nu = len(terms.stages.c), len(terms.stages.pull)

    def back(carry: tuple[CostHessian, CostGradient], s: tuple):
        (value, gradient), (stage, stiff, terms, push) = carry, s
        P = [[total((value.P[i][j], stiff[i] if i == j else None)) for j in range(nx)] for i in range(nx)]
        gradient = gradient._replace(p=[total(pair) for pair in zip(gradient.p, push, strict=True)])
        value, factors = factor_stage(value._replace(P=P), stage)
        before, k = gradient_stage(gradient, factors, stage, terms)
        return filled((value, before), zero), filled((factors, k, gradient.p), zero)

    blank = lambda n: [[zero] * nu for _ in range(n)]
    P, p = jax.tree.map(lambda e: e + zero, filled((system.end, terms.end), zero))
    begin = CostHessian(P, blank(nx), blank(nu)), CostGradient(p, [zero] * nu)
    stages = (system.stages, system.state, terms.stages, terms.state)
    factors, k, p = jax.lax.scan(compute_once(back), begin, stages, reverse=True)[1]
    return factors, BackwardPass(k, p, terms.stages.c)


def substitute(system: NewtonSystem, factors: StageFactors, terms: NewtonTerms) -> BackwardPass:
    """Run the backward sweep of a factorised system for another right-hand side; linear in `terms`."""
    zero = jnp.zeros_like(terms.stages.c[0][0])

    def back(after: CostGradient, s: tuple):
        factors, stage, terms, push = s
        after = after._replace(p=[total(pair) for pair in zip(after.p, push, strict=True)])
        before, k = gradient_stage(after, factors, stage, terms)
        return filled(before, zero), filled((k, after.p), zero)

    begin = CostGradient([e + zero for e in filled(terms.end, zero)], [zero] * len(terms.stages.pull))
    k, p = jax.lax.scan(back, begin, (factors, system.stages, terms.stages, terms.state), reverse=True)[1]
    return BackwardPass(k, p, terms.stages.c)


def solve_forward(
    system: NewtonSystem, factors: StageFactors, backward: BackwardPass, start: tuple[Components, Components]
) -> tuple[Components, Components, Components]:
    """Return the steps of later states and of inputs, and the costates after the step.

    `start` holds the steps of the first state and of the input before it.
    """
    nx = len(backward.c)

    def forth(carry: tuple[Components, Components], s: tuple):
        factors, stage, (k, p, c) = s
        dx, du = forward_stage(factors, k, stage, c, *carry)
        costate = [total((p[i], dot(factors.P[i], dx), dot(factors.S[i], du))) for i in range(nx)]
        return (dx, du), (dx, du, costate)

    return jax.lax.scan(compute_once(forth), start, (factors, system.stages, backward))[1]
