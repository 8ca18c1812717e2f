"""Steady states of both cars against SciPy, the known table, and the simulator."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy_steady_states import balance, nearest, steady_states

from driftjax.core import RESULTS, Control, State, rk4_step
from driftjax.equilibrium import (
    Branch,
    SlipRadius,
    SlipSpeed,
    SpeedYaw,
    decoupled_roots,
    solve_equilibrium,
    solve_nominal,
)
from driftjax.equilibrium.decoupled import drift_roots, pick
from driftjax.equilibrium.solve import ANY
from driftjax.vehicle import load_vehicle

CONFIGS = {name: load_vehicle(name) for name in ("sedan", "rc")}
CARS = {name: config.build() for name, config in CONFIGS.items()}
SPEEDS = {"sedan": (6.0, 10.0, 16.0), "rc": (1.0, 1.8, 3.0)}
RATIOS = (0.4, 0.7, 0.9, 0.97, 1.03, 1.1, 1.25)  # V r / (mu g)


@eqx.filter_jit
def at_each_root(car, V, r):
    """All roots and the solver's answer started a little off each."""

    def one(V, r):
        roots = decoupled_roots(car, V, r)

        def polish(x, u, kind):
            guess = x._replace(beta=x.beta + 0.01), Control(u.delta - 0.01, u.Fxr + 0.01 * car.m * 9.81)
            return solve_equilibrium(car, car, SpeedYaw(V, r), guess, branch=kind)

        return roots, jax.vmap(polish)(roots.x, roots.u, roots.kind)

    return jax.vmap(one)(V, r)


@eqx.filter_jit
def nominal(car, V, r, branch):
    return solve_nominal(car, SpeedYaw(V, r), branch=branch)


@pytest.mark.parametrize("name", CARS)
def test_every_steady_state_that_scipy_finds_is_found_and_solved(name):
    car, c = CARS[name], CONFIGS[name]
    V, ratio = (grid.ravel() for grid in np.meshgrid(SPEEDS[name], RATIOS))
    r = ratio * c.mu * 9.81 / V
    roots, solved = at_each_root(car, jnp.asarray(V), jnp.asarray(r))
    ok = np.asarray(solved.result == RESULTS.successful)
    count = 0
    for i in range(len(V)):
        rows = np.flatnonzero(np.asarray(roots.valid[i]))
        expected = steady_states(c, V[i], r[i])
        assert len(rows) == len(expected)
        for row, (beta, delta, Fxr) in zip(rows, sorted(expected, key=lambda y: (round(y[0], 9), y[1])), strict=True):
            ours = [float(leaf[i, row]) for leaf in (roots.x.beta, roots.u.delta, roots.u.Fxr)]
            np.testing.assert_allclose(ours, (beta, delta, Fxr), rtol=1e-9, atol=1e-9)
            assert np.max(np.abs(balance(c, V[i], ours[0], r[i], *ours[1:]))) < 1e-10
            count += 1
            assert ok[i, row]
            again = [float(leaf[i, row]) for leaf in (solved.x.beta, solved.u.delta, solved.u.Fxr)]
            np.testing.assert_allclose(again, ours, rtol=1e-7, atol=1e-7)
            best, converged = nearest(c, V[i], r[i], again)
            assert converged
            np.testing.assert_allclose(again, best, rtol=1e-7, atol=1e-8)
    assert count > 20


@pytest.mark.parametrize(
    ("name", "V", "degrees"), [("sedan", 12.0, (-28, -35, -39, -46)), ("rc", 2.0, (-21, -28, -33, -40))]
)
def test_known_drift_angles(name, V, degrees):
    car = CARS[name]
    for ratio, expected in zip((1.0, 1.05, 1.1, 1.2), degrees, strict=True):
        out = nominal(car, jnp.asarray(V), ratio * car.tyre.mu * 9.81 / V, Branch.COUNTERSTEER)
        assert out.result == RESULTS.successful and out.kind == Branch.COUNTERSTEER
        assert abs(np.rad2deg(out.x.beta) - expected) < 1.5
        assert out.u.Fxr > 0.65 * CONFIGS[name].mu * car.Fzr


def test_reference_point():
    out = nominal(CARS["sedan"], jnp.asarray(9.0), jnp.asarray(1.1), Branch.COUNTERSTEER)
    np.testing.assert_allclose([out.x.beta, out.u.delta, out.u.Fxr / 1e3], [-0.54507, -0.29676, 6.84925], atol=1e-5)
    assert out.residual < 1e-12


def test_tight_rc_corner_below_the_limit_has_no_drift():
    car = CARS["rc"]
    for R in (0.4, 0.6, 0.8):
        V = jnp.sqrt(0.95 * car.tyre.mu * 9.81 * R)
        for branch in (Branch.COUNTERSTEER, Branch.FRONT_SATURATED):
            assert nominal(car, V, V / R, branch).result == RESULTS.no_root


def test_right_turn_mirrors_left_turn():
    car = CARS["sedan"]
    for r in (1.1, 0.98 * 9.81 / 9.0):  # at the second the branch holds two drifts
        for branch in (Branch.COUNTERSTEER, Branch.FRONT_SATURATED):
            left, right = (nominal(car, jnp.asarray(9.0), jnp.asarray(yaw), branch) for yaw in (r, -r))
            assert left.result == RESULTS.successful
            np.testing.assert_allclose(right.x.beta, -left.x.beta, rtol=1e-9)
            np.testing.assert_allclose(right.u.delta, -left.u.delta, rtol=1e-9)
            np.testing.assert_allclose(right.u.Fxr, left.u.Fxr, rtol=1e-9)


@pytest.mark.parametrize("name", CARS)
def test_fixing_sideslip_and_radius_finds_the_same_points(name):
    car, V = CARS[name], SPEEDS[name][1]
    ratio = jnp.array([1.02, 1.1, 1.2])
    direct = eqx.filter_vmap(lambda q: nominal(car, jnp.asarray(V), q * car.tyre.mu * 9.81 / V, Branch.COUNTERSTEER))(
        ratio
    )

    @eqx.filter_jit
    @eqx.filter_vmap
    def through_radius(beta, R):
        x, u, exists = pick(drift_roots(car, beta, R), Branch.COUNTERSTEER)
        return exists, solve_equilibrium(
            car, car, SlipRadius(beta, R), (x._replace(V=1.1 * x.V), u), branch=Branch.COUNTERSTEER
        )

    exists, out = through_radius(direct.x.beta, V / direct.x.r)
    assert jnp.all(exists) and jnp.all(out.result == RESULTS.successful)
    for ours, theirs in zip(jax.tree.leaves((out.x, out.u)), jax.tree.leaves((direct.x, direct.u)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-7)
    by_speed = eqx.filter_vmap(
        lambda x, u: solve_equilibrium(car, car, SlipSpeed(x.beta, x.V), (x._replace(r=1.05 * x.r), u), branch=ANY)
    )(direct.x, direct.u)
    np.testing.assert_allclose(by_speed.x.r, direct.x.r, rtol=1e-7)


def test_a_wrong_guess_never_passes_for_the_branch_asked_for():
    car = CARS["sedan"]
    rng = np.random.default_rng(0)
    guess = State(*(jnp.asarray(v) for v in (np.full(200, 9.0), rng.uniform(-1.2, 0.6, 200), np.full(200, 1.1))))
    control = Control(jnp.asarray(rng.uniform(-0.9, 0.9, 200)), jnp.asarray(rng.uniform(0, 15e3, 200)))
    V, r = jnp.asarray(9.0), jnp.asarray(1.1)
    out = eqx.filter_jit(
        jax.vmap(lambda x, u: solve_equilibrium(car, car, SpeedYaw(V, r), (x, u), branch=Branch.COUNTERSTEER))
    )(guess, control)
    right = np.abs(np.asarray(out.x.beta) + 0.5450732) + np.abs(np.asarray(out.u.delta) + 0.2967579) < 1e-5
    good, off_branch = (np.asarray(out.result == which) for which in (RESULTS.successful, RESULTS.off_branch))
    assert np.all(right[good]) and np.any(good)
    assert np.any(off_branch)
    on_other = (np.asarray(out.residual) < 1e-9) & ~right
    assert np.all(off_branch[on_other])


def test_throw_raises_the_sentence():
    car = CARS["sedan"]
    other = nominal(car, jnp.asarray(9.0), jnp.asarray(1.1), Branch.FRONT_SATURATED)
    x, u = other.x, other.u
    with pytest.raises(eqx.EquinoxRuntimeError, match="another branch"):
        eqx.filter_jit(solve_equilibrium)(car, car, SpeedYaw(9.0, 1.1), (x, u), branch=Branch.COUNTERSTEER, throw=True)


@pytest.mark.parametrize("name", CARS)
def test_an_equilibrium_stays_put_in_the_simulator(name):
    car, V = CARS[name], SPEEDS[name][1]
    out = nominal(car, jnp.asarray(V), jnp.asarray(1.1 * float(car.tyre.mu) * 9.81 / V), Branch.COUNTERSTEER)
    step = lambda x, _: (rk4_step(lambda x: car(x, out.u), x, 0.005), None)
    end, _ = jax.jit(lambda x: jax.lax.scan(step, x, None, length=100))(out.x)
    np.testing.assert_allclose(end, out.x, rtol=1e-7)


def test_implicit_gradient_equals_central_differences():
    base, weight = CARS["sedan"], 1835.0 * 9.81

    @jax.jit
    def drift(p):
        mu, B, beta, R = p
        car = eqx.tree_at(lambda c: (c.tyre.mu, c.tyre.B), base, (mu, B))
        out = solve_nominal(car, SlipRadius(beta, R), branch=Branch.COUNTERSTEER)
        return jnp.stack([out.x.V, out.u.delta, out.u.Fxr / weight])

    @jax.jit
    def at(p):
        mu, B, V, r = p
        car = eqx.tree_at(lambda c: (c.tyre.mu, c.tyre.B), base, (mu, B))
        out = solve_nominal(car, SpeedYaw(V, r), branch=Branch.COUNTERSTEER)
        return jnp.stack([out.x.beta, out.u.delta, out.u.Fxr / weight])

    for f, p in ((drift, np.array([1.0, 10.92, -0.5, 12.0])), (at, np.array([1.0, 10.92, 9.0, 1.15]))):
        h = 1e-5
        difference = np.stack([(np.asarray(f(p + h * e)) - f(p - h * e)) / (2 * h) for e in np.eye(4)], axis=1)
        np.testing.assert_allclose(jax.jit(jax.jacrev(f))(p), difference, rtol=1e-5, atol=1e-7)
        assert np.min(np.abs(difference[0])) > 0
