"""Learning with an extended car: what its named effects could do is not taken from them."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import Control, State
from driftjax.equilibrium import Branch
from driftjax.learning.config import GPConfig, load_learn_config
from driftjax.learning.model import empty, update_model
from driftjax.learning.reference import Corner
from driftjax.learning.residual import known_effect_basis
from driftjax.learning.scenario import nominal_drift
from driftjax.vehicle import Extended, build_car, load_vehicle
from driftjax.vehicle.parameters import EffectParameterValue

FOUND = (EffectParameterValue("load_transfer_long", "h", 0.3), EffectParameterValue("rolling_resistance", "f", 0.015))
SEDAN = dataclasses.replace(load_vehicle("sedan"), combined_slip=1.0)
CAR: Any = build_car(dataclasses.replace(SEDAN, effects=FOUND))
BASIS: Any = known_effect_basis(CAR)
CONFIG = GPConfig(size=80, num_fit=60, restarts=1)
MEAN, SPREAD = np.array([9.0, -0.5, 1.1, -0.3, 6000.0]), np.array([0.8, 0.1, 0.2, 0.1, 1500.0])
LAGS = jnp.asarray([0.05, 0.1])
basis_of, means = jax.jit(BASIS), eqx.filter_jit(lambda gp, Z: jax.vmap(gp.mean)(Z))
updated = eqx.filter_jit(
    lambda Z, Y, known_basis: update_model(
        empty(CONFIG), Z, Y, jnp.ones(len(Z), bool), LAGS, CONFIG, jax.random.key(0), known_basis
    )
)


def inputs(num=160):
    rng = np.random.default_rng(0)
    return MEAN + SPREAD * rng.normal(size=(num, 5)), rng


def other(Z):
    """A residual that the named effects cannot make."""
    W = (Z - MEAN) / SPREAD
    return np.stack([0.3 * np.sin(2 * W[:, 3]), 0.1 * W[:, 1] * W[:, 2], 0.3 * np.cos(W[:, 0])], axis=1)


def test_the_nominal_car_has_no_basis():
    assert known_effect_basis(SEDAN.build()) is None and isinstance(CAR, Extended)


def test_the_basis_is_how_rates_change_with_the_parameters():
    Z, _ = inputs(5)
    basis, h = basis_of(Z), 1e-5
    assert basis.shape == (5, 3, 2)
    rates = jax.jit(
        jax.vmap(lambda theta, z: jnp.stack(CAR.with_parameters(theta)(State(*z[:3]), Control(*z[3:]))), (None, 0))
    )
    theta = np.asarray(CAR.theta)
    for k, step in enumerate(h * np.eye(2)):
        up, down = rates(theta + step, Z), rates(theta - step, Z)
        np.testing.assert_allclose(basis[:, :, k], (np.asarray(up) - down) / (2 * h), atol=1e-6)


@pytest.mark.slow
def test_another_value_of_a_named_effect_is_not_learnt_as_residual():
    Z, rng = inputs()
    caused = np.asarray(basis_of(Z)) @ [0.8, -0.6]
    Y = caused + 0.02 * np.std(caused, axis=0) * rng.normal(size=caused.shape)
    share = {}
    for name, known_basis in (("plain", None), ("orthogonal", BASIS)):
        model = updated(Z, Y, known_basis)
        mean = np.asarray(means(model.residual.gp, model.Z))
        share[name] = np.sqrt(np.sum(mean**2, axis=0) / np.sum(np.asarray(model.Y) ** 2, axis=0))
    assert np.all(share["plain"] > 0.7)  # without the orthogonality the GP takes nearly all of it
    assert np.all(share["orthogonal"] < 0.05)


def test_the_rest_is_learnt_and_trusted_all_the_same():
    Z, rng = inputs()
    rest, caused = other(Z), np.asarray(basis_of(Z)) @ [0.8, -0.6]
    noise = 0.02 * np.std(rest, axis=0) * rng.normal(size=rest.shape)
    model = updated(Z, rest + caused + noise, BASIS)
    assert np.all(np.asarray(model.residual.trust_factor) > 0.7)
    mean, mask = np.asarray(means(model.residual.gp, model.Z)), np.asarray(model.mask)
    basis = np.asarray(basis_of(model.Z))
    for d in range(3):
        J = basis[mask, d] / np.linalg.norm(basis[mask, d], axis=0).max()
        assert np.abs(J.T @ mean[mask, d]).max() < 1e-6 * np.linalg.norm(mean[mask, d])
        P = np.eye(mask.sum()) - J @ np.linalg.pinv(J)
        truth = P @ other(np.asarray(model.Z))[mask, d]
        assert np.linalg.norm(mean[mask, d] - truth) < 0.2 * np.linalg.norm(truth)


@pytest.mark.slow
def test_where_tyres_have_no_peak_the_corner_is_slid_through_within_it():
    car: Any = build_car(load_vehicle("dart").with_combined_slip(1.0))
    config = load_learn_config("dart")
    steady, branch = nominal_drift(car, Corner(V_b=2.3, r_b=2.0, R=1.2, beta=-config.drift_beta), config)
    assert branch == Branch.GRIP and abs(float(steady.x.beta)) == config.drift_beta
    rates, slips = eqx.filter_jit(lambda car, x, u: (car(x, u), car.slip_angles(x, u)))(car, steady.x, steady.u)
    assert np.max(np.abs(rates)) < 1e-6
    slips = np.abs(slips)
    assert np.all(slips < np.stack(car.peaks)) and slips[1] > 0.4
