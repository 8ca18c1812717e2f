"""Learning with an extended car: what its named effects could do is not taken from them."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from driftjax.core import Control, State
from driftjax.equilibrium import Branch
from driftjax.learning.config import GPConfig, load_learn_config
from driftjax.learning.model import empty, learn
from driftjax.learning.reference import Corner
from driftjax.learning.residual import known_effect_basis
from driftjax.learning.scenario import nominal_drift
from driftjax.vehicle import Extended, build_car, load_vehicle
from driftjax.vehicle.parameters import EffectParameterValue

FOUND = (EffectParameterValue("load_transfer_long", "h", 0.3), EffectParameterValue("rolling_resistance", "f", 0.015))
SEDAN = dataclasses.replace(load_vehicle("sedan"), combined_slip=1.0)
CAR: Any = build_car(dataclasses.replace(SEDAN, effects=FOUND))
CLAIM: Any = known_effect_basis(CAR)
CONFIG = GPConfig(size=80, num_fit=60, restarts=1)
MEAN, SPREAD = np.array([9.0, -0.5, 1.1, -0.3, 6000.0]), np.array([0.8, 0.1, 0.2, 0.1, 1500.0])
LAGS = jnp.asarray([0.05, 0.1])
learnt = eqx.filter_jit(
    lambda Z, Y, known_basis: learn(
        empty(CONFIG), Z, Y, jnp.ones(len(Z), bool), LAGS, CONFIG, jax.random.key(0), known_basis
    )
)


def inputs(num=160):
    rng = np.random.default_rng(0)
    return jnp.asarray(MEAN + SPREAD * rng.normal(size=(num, 5))), rng


def other(Z):
    """A residual that the named effects cannot make."""
    W = (Z - MEAN) / SPREAD
    return jnp.stack([0.3 * jnp.sin(2 * W[:, 3]), 0.1 * W[:, 1] * W[:, 2], 0.3 * jnp.cos(W[:, 0])], axis=1)


def test_the_nominal_car_claims_nothing():
    assert known_effect_basis(SEDAN.build()) is None and isinstance(CAR, Extended)


def test_claims_are_how_rates_change_with_the_parameters():
    Z, _ = inputs(5)
    found, h = jax.jit(CLAIM)(Z), 1e-5
    assert found.shape == (5, 3, 2)
    rates = lambda theta, z: jnp.stack(CAR.with_parameters(theta)(State(*z[:3]), Control(*z[3:])))
    for k in range(2):
        up, down = (jax.vmap(lambda z, s=s: rates(CAR.theta.at[k].add(s), z))(Z) for s in (h, -h))  # noqa: B023
        np.testing.assert_allclose(found[:, :, k], (up - down) / (2 * h), atol=1e-6)


def test_another_value_of_a_named_effect_is_not_learnt_as_residual():
    Z, rng = inputs()
    caused = CLAIM(Z) @ jnp.asarray([0.8, -0.6])
    Y = caused + 0.02 * jnp.std(caused, axis=0) * rng.normal(size=caused.shape)
    share = {}
    for name, known_basis in (("plain", None), ("orthogonal", CLAIM)):
        found = learnt(Z, Y, known_basis)
        mean = jax.vmap(found.residual.gp.mean)(found.Z)
        share[name] = jnp.sqrt(jnp.sum(mean**2, axis=0) / jnp.sum(found.Y**2, axis=0))
    assert np.all(share["plain"] > 0.7)  # without the orthogonality the GP takes nearly all of it
    assert np.all(share["orthogonal"] < 0.05)


def test_the_rest_is_learnt_and_trusted_all_the_same():
    Z, rng = inputs()
    rest, caused = other(Z), CLAIM(Z) @ jnp.asarray([0.8, -0.6])
    noise = 0.02 * jnp.std(rest, axis=0) * rng.normal(size=rest.shape)
    found = learnt(Z, rest + caused + noise, CLAIM)
    assert np.all(np.asarray(found.residual.trust_factor) > 0.7)
    mean, mask = np.asarray(jax.vmap(found.residual.gp.mean)(found.Z)), np.asarray(found.mask)
    basis = np.asarray(CLAIM(found.Z))
    for d in range(3):
        J = basis[mask, d] / np.linalg.norm(basis[mask, d], axis=0).max()
        assert np.abs(J.T @ mean[mask, d]).max() < 1e-6 * np.linalg.norm(mean[mask, d])
        P = np.eye(mask.sum()) - J @ np.linalg.pinv(J)
        truth = P @ np.asarray(other(found.Z))[mask, d]
        assert np.linalg.norm(mean[mask, d] - truth) < 0.2 * np.linalg.norm(truth)


def test_where_tyres_have_no_peak_the_corner_is_slid_through_within_it():
    car: Any = build_car(load_vehicle("dart").with_combined_slip(1.0))
    config = load_learn_config("dart")
    steady, branch = nominal_drift(car, Corner(V_b=2.3, r_b=2.0, R=1.2, beta=-config.drift_beta), config)
    assert branch == Branch.GRIP and abs(float(steady.x.beta)) == config.drift_beta
    assert jnp.max(jnp.abs(jnp.stack(car(steady.x, steady.u)))) < 1e-6
    peaks, slips = jnp.stack(car.peaks), jnp.abs(jnp.stack(car.slip_angles(steady.x, steady.u)))
    assert jnp.all(slips < peaks) and slips[1] > 0.4
