"""Parameters of effects fitted to the laps of one plant: the prior mean of the Gaussian process."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import BadInput, Control, State, rk4_step
from driftjax.equilibrium import Branch, SlipRadius, continuation, solve_steady
from driftjax.gp import zero_gp
from driftjax.learning.config import GPConfig
from driftjax.learning.model import empty, update_model
from driftjax.learning.residual import known_effect_basis, residual_rate
from driftjax.learning.tuning import left_over, tune_parameters
from driftjax.vehicle import Extended, Residual, build_car, load_vehicle, no_residual
from driftjax.vehicle.parameters import EffectParameterValue

EFFECTS = ("friction_front", "friction_rear", "drive_gain")
SEDAN = dataclasses.replace(load_vehicle("sedan"), combined_slip=1.0)
CAR: Any = build_car(SEDAN, EFFECTS)
TRUTH = jnp.array([-1.5, 1.0, -0.5])  # typical sizes
PLANT = CAR.with_parameters(TRUTH)
DT = jnp.asarray(0.05)
CONFIG = GPConfig(size=80, num_fit=60, restarts=1, effects=EFFECTS)
MEAN, SPREAD = np.array([9.0, -0.5, 1.1, -0.3, 6000.0]), np.array([0.8, 0.1, 0.2, 0.1, 1500.0])
LAGS = jnp.asarray([0.05, 0.1])


def measured(car, z):
    """Return the residual rates of the nominal car over a step that `car` makes."""
    x, u = State(z[0], z[1], z[2]), Control(z[3], z[4])
    return residual_rate(CAR, x, u, rk4_step(lambda w: car(w, u), x, DT), DT)


rates_of = jax.jit(jax.vmap(lambda z: measured(PLANT, z)))
fit = eqx.filter_jit(lambda car, Z, Y, mask: tune_parameters(car, EFFECTS, Z, Y, mask, DT))
left = eqx.filter_jit(lambda tuning, Z, Y, mask: left_over(CAR, tuning, Z, Y, mask, DT))
learn = eqx.filter_jit(
    lambda model, Z, Y: update_model(
        model, Z, Y, jnp.ones(len(Z), bool), LAGS, CONFIG, jax.random.key(0), car=(CAR, DT)
    )
)


def lap(num=160, seed=0, tied=False):
    """Inputs of a lap, all independent or with the commands a function of the state, as by a feedback."""
    rng = np.random.default_rng(seed)
    w = rng.normal(size=(num, 5))
    if tied:
        w[:, 3], w[:, 4] = 0.9 * w[:, 1] - 0.4 * w[:, 2], 0.8 * w[:, 0]
    return jnp.asarray(MEAN + SPREAD * w)


def noisy(Y, seed=1):
    rng = np.random.default_rng(seed)
    return Y + 0.05 * jnp.std(Y, axis=0) * jnp.asarray(rng.normal(size=Y.shape))


def test_the_rates_of_the_right_parameters_leave_nothing():
    Z = lap()
    rest = left(TRUTH, Z, rates_of(Z), jnp.ones(len(Z), bool))
    rms = lambda a: np.sqrt(np.mean(np.asarray(a) ** 2, axis=0))
    assert np.all(rms(rest) < 0.03 * rms(rates_of(Z)))  # `residual_rate` corrects twice only


def test_planted_parameters_are_found_whatever_ties_the_commands():
    for tied in (False, True):
        Z = lap(tied=tied)
        found = fit(CAR, Z, noisy(rates_of(Z)), jnp.ones(len(Z), bool))
        assert found == pytest.approx(np.asarray(TRUTH), abs=0.15)


def test_rows_that_are_not_data_do_not_matter():
    Z = lap()
    Y, mask = noisy(rates_of(Z)), jnp.arange(len(Z)) < 120
    spoilt = jnp.where(mask[:, None], Z, 0.0), jnp.where(mask[:, None], Y, 100.0)
    assert fit(CAR, *spoilt, mask) == pytest.approx(np.asarray(fit(CAR, Z, Y, mask)), abs=1e-9)


def test_parameters_stay_within_the_limits_of_the_catalogue():
    Z = lap()
    mask = jnp.ones(len(Z), bool)
    assert np.all(np.abs(fit(CAR, Z, 100 * rates_of(Z), mask)) <= 4)


def test_effects_that_are_not_free_keep_their_value():
    named = dataclasses.replace(SEDAN, effects=(EffectParameterValue("mass", "p", 0.03),))
    car: Any = build_car(named, EFFECTS)
    Z = lap()
    found = np.asarray(fit(car, Z, rates_of(Z), jnp.ones(len(Z), bool)))
    at = car.columns(("mass",))
    assert found[at] == 0 and np.all(np.delete(found, at) != 0) and float((car.scale * car.theta)[at[0]]) == 0.03
    assert known_effect_basis(CAR, EFFECTS) is None
    basis: Any = known_effect_basis(car, EFFECTS)
    assert basis(Z[:2]).shape == (2, 3, 1)


def test_the_gp_is_used_from_the_second_lap_on():
    Z = lap()
    wave = 0.1 * jnp.std(rates_of(Z), axis=0) * jnp.sin(2 * (Z[:, :1] - MEAN[0]) / SPREAD[0])
    first = learn(empty(CONFIG, nominal=CAR), Z, rates_of(Z) + wave)
    assert np.all(first.residual.trust_factor == 0) and np.any(first.residual.tuning != 0)
    Z2 = lap(seed=5)
    wave = 0.1 * jnp.std(rates_of(Z), axis=0) * jnp.sin(2 * (Z2[:, :1] - MEAN[0]) / SPREAD[0])
    second = learn(first, Z2, rates_of(Z2) + wave)
    assert np.all(second.residual.trust_factor > 0.3)


def test_one_lap_of_a_feedback_gives_the_slopes_that_a_zero_mean_gp_lacks():
    Z = lap(tied=True)
    Y = noisy(rates_of(Z))
    tuned = learn(empty(CONFIG, nominal=CAR), Z, Y).residual
    plain = dataclasses.replace(CONFIG, effects=())
    zero_mean = eqx.filter_jit(update_model)(
        empty(plain), Z, Y, jnp.ones(len(Z), bool), LAGS, plain, jax.random.key(0)
    ).residual
    rates = lambda car, z: jnp.stack(car(State(z[0], z[1], z[2]), Control(z[3], z[4])))
    by_steer = lambda f: jax.jit(jax.vmap(jax.jacfwd(f)))(Z)[:, :, 3]
    truth = by_steer(lambda z: rates(PLANT, z) - rates(CAR, z))
    errors = [np.mean((by_steer(lambda z, d=d: rates(d.tuned(CAR), z) + d(z) - rates(CAR, z)) - truth) ** 2, axis=0)
              for d in (tuned, zero_mean)]  # fmt: skip
    assert np.all(errors[0] < 0.1 * errors[1])


def test_the_share_of_a_residual_scales_its_parameters():
    whole = Residual(zero_gp(4, 5, 3), jnp.ones(3), LAGS, tuning=TRUTH)
    half: Any = whole.scaled(jnp.asarray(0.5)).tuned(CAR)
    assert np.allclose(half.theta, TRUTH / 2) and no_residual(zero_gp(4, 5, 3)).tuned(CAR) is CAR
    assert whole.tuned(SEDAN.build()) == SEDAN.build()


def test_steady_drifts_are_those_of_the_tuned_car():
    fixed = SlipRadius(jnp.asarray(-0.45), jnp.asarray(12.0))
    nominal = eqx.filter_jit(solve_steady)(CAR, fixed, branch=Branch.COUNTERSTEER)
    d = Residual(zero_gp(4, 5, 3), jnp.ones(3), LAGS, tuning=TRUTH)
    steady = eqx.filter_jit(continuation)(CAR, d, fixed, (nominal.x, nominal.u), branch=Branch.COUNTERSTEER)
    expected = eqx.filter_jit(solve_steady)(PLANT, fixed, branch=Branch.COUNTERSTEER)
    assert float(steady.x.V) == pytest.approx(float(expected.x.V), rel=1e-6)
    assert abs(float(steady.x.V - nominal.x.V)) > 0.05


def test_effects_without_a_steady_state_are_refused_with_the_list():
    for name in ("steer_lag", "nonsense"):
        with pytest.raises(BadInput, match=f"'{name}'; choose among friction, "):
            GPConfig(effects=(name,))
    assert isinstance(build_car(SEDAN, EFFECTS), Extended)
