"""Tyres: limits, the friction circle, dissipation and smoothness."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from driftjax.tyre import CurvedPacejka, MagicFormula, SimplifiedPacejka

FZ, FZ0 = jnp.asarray(4500.0), jnp.asarray(4000.0)


def tyre(**changes):
    values = dict(mu=1.1, B=11.0, C=1.4, E=0.1, slip_ratio=1.2, load_sensitivity=0.1) | changes
    return MagicFormula(**values)


forces = eqx.filter_jit(lambda tyre, *at: tyre.forces(*at))


def reference(mu, B, C, E, slip_ratio, load_sensitivity, kappa, alpha):
    """The same law in polar form, one wheel at a time, without JAX."""
    friction = mu * np.exp(-load_sensitivity * (4500.0 / 4000.0 - 1))
    angle, rho = np.arctan2(-alpha, slip_ratio * kappa), np.hypot(slip_ratio * kappa, alpha)
    inner = (1 - E) * B * rho + E * np.arctan(B * rho)
    force = friction * 4500.0 * np.sin(C * np.arctan(inner))
    return force * np.cos(angle), force * np.sin(angle)


def test_forces_equal_an_independent_transcription():
    values = dict(mu=1.1, B=11.0, C=1.4, E=0.1, slip_ratio=1.2, load_sensitivity=0.1)
    rng = np.random.default_rng(0)
    for kappa, alpha in rng.uniform(-1, 1, (20, 2)):
        got = forces(tyre(), kappa, alpha, FZ, FZ0)
        np.testing.assert_allclose(got, reference(**values, kappa=kappa, alpha=alpha), rtol=1e-5, atol=0.1)


def test_pure_lateral_slip_without_extras_is_the_nominal_tyre():
    alpha: Any = np.linspace(-0.8, 0.8, 41)
    Fx, Fy = forces(tyre(E=0.0, load_sensitivity=0.0), np.zeros(41), alpha, FZ, FZ0)
    np.testing.assert_allclose(
        Fy, eqx.filter_jit(SimplifiedPacejka(1.1, 11.0, 1.4).lateral)(alpha, FZ), rtol=1e-5, atol=1e-6
    )
    np.testing.assert_allclose(Fx, 0.0, atol=1e-9)


def test_no_force_leaves_the_friction_circle_and_none_adds_energy():
    kappa, alpha = np.random.default_rng(1).normal(0, 2, (2, 2000))
    Fx, Fy = map(np.asarray, forces(tyre(), kappa, alpha, FZ, FZ0))
    limit = float(tyre().friction(FZ, FZ0) * FZ)
    assert np.hypot(Fx, Fy).max() <= limit * (1 + 1e-12)
    assert np.hypot(Fx, Fy).max() > 0.999 * limit  # and the circle is reached
    assert np.all(Fx * kappa - Fy * alpha >= 0)


def test_stiffness_at_small_slip_is_the_product_of_the_factors():
    slope = jax.jit(jax.grad(lambda alpha: tyre().forces(jnp.asarray(0.0), alpha, FZ, FZ0)[1]))(0.0)
    friction = float(tyre().friction(FZ, FZ0))
    np.testing.assert_allclose(slope, -friction * 4500.0 * 11.0 * 1.4, rtol=1e-5)


def test_friction_falls_with_load_by_the_sensitivity():
    at = lambda load: float(tyre().friction(jnp.asarray(load), FZ0))
    np.testing.assert_allclose(at(4000.0), 1.1)
    np.testing.assert_allclose((at(4400.0) - at(4000.0)) / 1.1, -0.1 * 0.1, rtol=0.01)


@pytest.mark.parametrize("load", [0.0, 4500.0])
def test_gradients_are_finite_without_slip_and_without_load(load):
    total = lambda z: sum(tyre().forces(z[0], z[1], z[2], FZ0))
    assert np.isfinite(jax.jit(jax.grad(total))(np.array([0.0, 0.0, load]))).all()


@pytest.mark.parametrize(("B", "C"), [(10.92, 1.458), (18.10, 1.323)])
def test_nominal_peak_is_where_the_force_is_largest(B, C):
    law = SimplifiedPacejka(1.0, B, C)
    lateral = eqx.filter_jit(law.lateral)
    best: Any = minimize_scalar(lambda a: float(lateral(jnp.asarray(a), FZ)), bounds=(0.01, 0.6), method="bounded")
    np.testing.assert_allclose(law.alpha_peak, best.x, atol=1e-4)
    np.testing.assert_allclose(-best.fun, 4500.0)


@eqx.filter_jit
def curves(C, p, alpha):
    """Forces over load (n, m) of free-form tyres of shape factors `C` (n,) at `p` (n, 3), and their peaks (n,)."""

    def one(C, p):
        law = CurvedPacejka(1.0, 10.0, C, tuple(jnp.expm1(p)))
        return -law.lateral(alpha, jnp.ones(())), law.alpha_peak

    return jax.vmap(one)(C, p)


def test_a_free_form_keeps_stiffness_and_largest_force_and_has_one_peak_whatever_its_parameters():
    rng, C = np.random.default_rng(0), np.repeat([1.05, 1.458, 1.95], 60)
    p = rng.uniform(-1.6, 1.6, (180, 3)) * rng.choice([1, 4], (180, 1))  # as the effect's bounds, and far beyond them
    alpha = np.tan(np.pi / 2 * np.linspace(0.0, 0.99, 3000)) / 10.0
    force, peak = map(np.asarray, curves(C, p, alpha))
    top, rise = force.argmax(axis=1), np.diff(force, axis=1)
    before = np.arange(2999) < top[:, None]
    assert (rise[before] > -1e-12).all() and (rise[~before] < 1e-12).all() and (force > -1e-12).all()
    np.testing.assert_allclose(force[:, 1] / alpha[1], 10.0 * C, rtol=1e-3)
    within = (top > 0) & (top < 2998)
    np.testing.assert_allclose(force.max(axis=1)[within], 1.0, atol=1e-4)
    assert within.sum() > 100 and (np.abs(peak - alpha[top]) <= 2 * np.gradient(alpha)[top])[within].all()


def test_a_free_form_without_parameters_is_the_formula_to_the_bit_and_odd():
    alpha = jnp.linspace(-1.0, 1.0, 401)
    formula, law = SimplifiedPacejka(0.9, 18.1, 1.323), CurvedPacejka(0.9, 18.1, 1.323, (jnp.zeros(()),) * 3)

    def lateral(law, alpha):  # to the bit as programs of the package are compiled, with LLVM's optimisations
        arrays, static = eqx.partition(law, eqx.is_array)
        force = lambda arrays, alpha: eqx.combine(arrays, static).lateral(alpha, FZ)
        return jax.jit(force, compiler_options={"xla_backend_optimization_level": 3})(arrays, alpha)

    np.testing.assert_array_equal(lateral(law, alpha), lateral(formula, alpha))
    np.testing.assert_allclose(law.alpha_peak, formula.alpha_peak, rtol=1e-9)
    bent = CurvedPacejka(0.9, 18.1, 1.323, tuple(jnp.array([0.6, -0.7, 2.0])))
    np.testing.assert_allclose(lateral(bent, alpha), -lateral(bent, -alpha), atol=1e-9)
