"""The quadratic programs of a batch against qpOASES on the dense problem: random, degenerate and infeasible ones."""

from functools import cache
from typing import Any, NamedTuple

import casadi as ca
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from driftjax.core import RESULTS
from driftjax.solve import Options, solve_batch
from driftjax.solve.batch_ocp import AbstractBatchOCP
from driftjax.solve.component_derivatives import dot

N, NX, NU = 4, 2, 2
NZ = NX + NU
SIZES = {"random": 12, "weakly active": 4, "redundant": 4, "rank-deficient": 4, "infeasible": 6}


class Program(NamedTuple):
    """Stage-wise quadratic programs, the batch on the last axis; rows of `H`, `h` for the stages and the end."""

    A: Any  # (NX, NX, N, batch)
    B: Any  # (NX, NU, N, batch)
    c: Any  # (NX, N, batch)
    H: Any  # (NZ, NZ, N+1, batch); at the end only the block of the state counts
    h: Any  # (NZ, N+1, batch)
    rate: Any  # (NU, batch)
    limits: Any  # (3, 2, 2, batch): family, entry, lower and upper
    x0: Any  # (NX, batch)
    before: Any  # (NU, batch)


class LinearQuadratic(AbstractBatchOCP):
    """The same as a problem of the batched solver; its parameters are the matrices."""

    rate: Array  # (batch, NU)
    limits: Array  # (batch, 3, 2, 2)

    def step(self, x, u, p):
        return [dot(A, x) + dot(B, u) + c for A, B, c in zip(p["A"], p["B"], p["c"], strict=True)]

    def cost(self, x, u, p):
        z = [*x, *u]
        return 0.5 * sum(p["H"][i][j] * z[i] * z[j] for i in range(len(z)) for j in range(len(z))) + dot(
            p["h"][: len(z)], z
        )

    def terminal(self, x, p):
        return self.cost(x, [], p)

    def rate_weight(self):
        return list(self.rate.T)

    def _pairs(self, family: int):
        return [(self.limits[:, family, i, 0], self.limits[:, family, i, 1]) for i in range(2)]

    def input_limits(self):
        return self._pairs(0)

    def change_limits(self):
        return self._pairs(1)

    def state_limits(self):
        return self._pairs(2)


def random_programs(rng: np.random.Generator, batch: int) -> Program:
    """Return strictly convex programs with limits that a good part of the optima reach."""
    normal = rng.normal
    root = normal(size=(NZ, NZ, N + 1, batch))
    limits = np.array([[1.0, 1.2], [0.6, 0.8], [1.5, 1.5]])[..., None] * rng.uniform(0.5, 1.5, (3, 2, batch))
    return Program(
        A=np.eye(NX)[..., None, None] + 0.3 * normal(size=(NX, NX, N, batch)),
        B=normal(size=(NX, NU, N, batch)),
        c=0.1 * normal(size=(NX, N, batch)),
        H=np.einsum("ikab,jkab->ijab", root, root) + 0.05 * np.eye(NZ)[..., None, None],
        h=2 * normal(size=(NZ, N + 1, batch)),
        rate=rng.uniform(0, 1, (NU, batch)),
        limits=np.stack([-limits, limits], axis=2),
        x0=0.5 * normal(size=(NX, batch)),
        before=0.3 * normal(size=(NU, batch)),
    )


def weakly_active(rng: np.random.Generator, batch: int) -> Program:
    """Return programs whose optimum touches a limit of an input and of a state with multipliers of zero."""
    p = random_programs(rng, batch)
    p.limits[:] *= 100
    for entry in range(batch):
        found = oracle(p, entry)
        assert found is not None
        U = found[0]
        p.limits[0, 0, 1, entry] = U[0].max()
        p.limits[2, 1, 0, entry] = states(p, entry, U)[1].min()
    return p


def redundant(rng: np.random.Generator, batch: int) -> Program:
    """Return programs where the limits of the first input and of its change hold the first stage at one value."""
    p = random_programs(rng, batch)
    p.limits[2] *= 100
    p.h[NX] = -50.0
    p.limits[0, 0, 1] = p.before[0] + p.limits[1, 0, 1]
    return p


def rank_deficient(rng: np.random.Generator, batch: int) -> Program:
    """Return programs linear in the first input, and with no cost and no effect of the second."""
    p = random_programs(rng, batch)
    p.limits[2] *= 100
    p.H[NX:], p.H[:, NX:], p.rate[:] = 0.0, 0.0, 0.0
    p.B[:, 1], p.h[NX + 1] = 0.0, 0.0
    return p


def infeasible(rng: np.random.Generator, batch: int) -> Program:
    """Return programs with a state out of reach, or an input that its changes do not bring within its limits."""
    p = random_programs(rng, batch)
    half = batch // 2
    p.limits[2, 0, 0, :half], p.limits[2, 0, 1, :half] = 50.0, 60.0
    p.before[0, half:] = p.limits[0, 0, 1, half:] + 1.2 * p.limits[1, 0, 1, half:]
    return p


@cache
def programs() -> Program:
    """Return all of them in one batch, in the order of `SIZES`."""
    rng = np.random.default_rng(0)
    kinds = (random_programs, weakly_active, redundant, rank_deficient, infeasible)
    parts = [kind(rng, size) for kind, size in zip(kinds, SIZES.values(), strict=True)]
    return Program(*(np.concatenate(arrays, axis=-1) for arrays in zip(*parts, strict=True)))


def states(p: Program, entry: int, U: np.ndarray) -> np.ndarray:
    """Return the states (NX, N) of stages 1 to N."""
    X = [p.x0[:, entry]]
    for k in range(N):
        X.append(p.A[..., k, entry] @ X[-1] + p.B[..., k, entry] @ U[:, k] + p.c[:, k, entry])
    return np.array(X[1:]).T


class Dense(NamedTuple):
    """Program of one entry in the inputs alone: minimise half of U'HU + g'U + constant with low <= C U <= high."""

    H: np.ndarray
    g: np.ndarray
    constant: float
    C: np.ndarray
    low: np.ndarray
    high: np.ndarray


def dense(p: Program, entry: int) -> Dense:
    """Return the program of one entry with the states eliminated."""
    A, B, c, H, h, rate, limits, x0, before = (a[..., entry] for a in p)
    n = N * NU
    T, x, states, offsets = np.zeros((NX, n)), x0, [np.zeros((NX, n))], [x0]  # x_k = T U + x
    for k in range(N):
        T = A[..., k] @ T
        T[:, k * NU : (k + 1) * NU] += B[..., k]
        x = A[..., k] @ x + c[:, k]
        states, offsets = [*states, T], [*offsets, x]
    picks = [np.eye(n)[k * NU : (k + 1) * NU] for k in range(N)]
    total, gradient, constant = np.zeros((n, n)), np.zeros(n), 0.0
    for k in range(N + 1):
        size = NZ if k < N else NX
        Z = np.concatenate([states[k], picks[k]]) if k < N else states[k]
        z = np.concatenate([offsets[k], np.zeros(NU)])[:size]
        stage, slope = H[:size, :size, k], h[:size, k]
        total += Z.T @ stage @ Z
        gradient += Z.T @ (stage @ z + slope)
        constant += float(0.5 * z @ stage @ z + slope @ z)
    D = np.concatenate(picks) - np.concatenate([np.zeros((NU, n)), *picks[:-1]])
    d = np.concatenate([-before, np.zeros(n - NU)])
    R = np.diag(np.tile(2 * rate, N))
    total, gradient, constant = total + D.T @ R @ D, gradient + D.T @ R @ d, constant + float(0.5 * d @ R @ d)
    C = np.concatenate([np.eye(n), D, *states[1:]])
    shift = np.concatenate([np.zeros(n), d, *offsets[1:]])
    low, high = (np.concatenate([np.tile(limits[f, :, side], N) for f in range(3)]) - shift for side in (0, 1))
    return Dense(total, gradient, constant, C, low, high)


@cache
def qpoases(variables: int, rows: int) -> ca.Function:
    options = {"printLevel": "none", "error_on_fail": False, "nWSR": 1000, "terminationTolerance": 1e-12}
    shape = {"h": ca.Sparsity.dense(variables, variables), "a": ca.Sparsity.dense(rows, variables)}
    return ca.conic("oracle", "qpoases", shape, options)


def oracle(p: Program, entry: int) -> tuple[np.ndarray, float] | None:
    """Return inputs (NU, N) and cost of qpOASES' optimum; None where there is no feasible point."""
    d = dense(p, entry)
    solver = qpoases(*d.C.shape[::-1])
    found = solver(h=d.H, g=d.g, a=d.C, lba=d.low, uba=d.high)
    if not solver.stats()["success"]:
        return None
    return np.asarray(found["x"]).reshape(N, NU).T, float(found["cost"]) + d.constant


@eqx.filter_jit
def solve_programs(p: Program, options: Options):
    dtype = p.x0.dtype
    matrix = lambda a: [[e if e.shape[0] == N + 1 else jnp.concatenate([e, e[-1:]]) for e in row] for row in a]
    params = {"A": matrix(p.A), "B": matrix(p.B), "H": matrix(p.H), "c": matrix([p.c])[0], "h": matrix([p.h])[0]}
    ocp = LinearQuadratic(jnp.moveaxis(p.rate, -1, 0), jnp.moveaxis(p.limits, -1, 0))
    batch = p.x0.shape[1]
    X = jnp.broadcast_to(p.x0[:, None], (NX, N + 1, batch))
    return solve_batch(ocp, p.x0, p.before, params, X, jnp.zeros((NU, N, batch), dtype), options)


@cache
def solved(dtype: type, tolerance: float):
    p = Program(*(jnp.asarray(a, dtype) for a in programs()))
    return solve_programs(p, Options(tolerance, 1.0, 1))


@cache
def oracles() -> list[tuple[np.ndarray, float] | None]:
    return [oracle(programs(), entry) for entry in range(sum(SIZES.values()))]


def of_kind(name: str) -> range:
    start = sum(list(SIZES.values())[: list(SIZES).index(name)])
    return range(start, start + SIZES[name])


PRECISIONS = pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-8), (np.float32, 1e-4)])


@PRECISIONS
def test_one_iteration_solves_every_program_that_has_a_feasible_point(dtype, tolerance):
    plans, feasible = solved(dtype, tolerance), np.array([found is not None for found in oracles()])
    assert plans.U.dtype == dtype
    assert not feasible[of_kind("infeasible")].any()  # else qpOASES would have told nothing
    assert feasible[: of_kind("infeasible")[0]].mean() > 0.9  # state limits make some random ones infeasible
    np.testing.assert_array_equal(plans.result == RESULTS.successful, feasible)
    np.testing.assert_array_equal(plans.result == RESULTS.infeasible, ~feasible)
    assert np.asarray(plans.qp_error)[feasible].max() <= tolerance
    assert np.asarray(plans.qp_steps)[~feasible].max() < 20  # long before the last iteration allowed


@PRECISIONS
@pytest.mark.parametrize("name", [name for name in SIZES if name != "infeasible"])
def test_the_optimum_is_that_of_qpoases(name, dtype, tolerance):
    plans, active = solved(dtype, tolerance), 0
    for entry in of_kind(name):
        found = oracles()[entry]
        if found is None:
            continue
        U, cost = found
        mine = np.asarray(plans.U[..., entry], float)
        np.testing.assert_allclose(plans.cost[entry], cost, rtol=10 * tolerance, atol=100 * tolerance)
        if name == "rank-deficient":
            continue  # many inputs are optimal
        # products of slack and multiplier leave a weakly active limit at the root of the tolerance
        np.testing.assert_allclose(mine, U, atol=10 * tolerance**0.5 if name == "weakly active" else 100 * tolerance)
        values = [U, np.diff(U, axis=1, prepend=programs().before[:, entry, None]), states(programs(), entry, U)]
        sides = programs().limits[..., entry]
        active += sum(
            int(np.sum(np.abs(v - b[:, side, None]) < 1e-9))
            for v, b in zip(values, sides, strict=True)
            for side in (0, 1)
        )
    assert name == "rank-deficient" or active > SIZES[name]  # else no limit would have been tested
