"""Nominal car: Eq. 1-3 against Newton's law in the body frame, symmetry, limits."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import Control, State
from driftjax.vehicle import SingleTrack, load_vehicle

CARS = ["sedan", "rc"]
LIMITS = {"sedan": (20.0, 1.0, 7000.0), "rc": (4.0, 4.0, 7.0)}


def newton(config, V, beta, r, delta, Fxr):
    """Rates (V, beta, r) from the forces in the body frame and the rotation of that frame, without JAX."""
    g = 9.81
    vx, vy = V * np.cos(beta), V * np.sin(beta)
    tyre = lambda alpha, Fz: -config.mu * Fz * np.sin(config.C * np.arctan(config.B * alpha))
    L = config.a + config.b
    front = tyre(np.arctan((vy + config.a * r) / vx) - delta, config.m * g * config.b / L)
    rear = tyre(np.arctan((vy - config.b * r) / vx), config.m * g * config.a / L)
    ax = (Fxr - front * np.sin(delta)) / config.m + r * vy
    ay = (rear + front * np.cos(delta)) / config.m - r * vx
    yaw = (config.a * front * np.cos(delta) - config.b * rear) / config.Iz
    return (vx * ax + vy * ay) / V, (vx * ay - vy * ax) / V**2, yaw


def samples(name, num=30):
    V, r, Fxr = LIMITS[name]
    rng = np.random.default_rng(0)
    low = np.array([0.2 * V, -0.9, -r, -0.5, -Fxr])
    return rng.uniform(low, np.array([V, 0.9, r, 0.5, Fxr]), (num, 5))


def at(z):
    return State(*map(jnp.asarray, z[:3])), Control(*map(jnp.asarray, z[3:]))


@pytest.mark.parametrize("name", CARS)
def test_rates_follow_from_newtons_law(name):
    config = load_vehicle(name)
    for z in samples(name):
        np.testing.assert_allclose(config.build()(*at(z)), newton(config, *z), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", CARS)
def test_mirrored_state_gives_mirrored_rates(name):
    car = load_vehicle(name).build()
    for z in samples(name, 5):
        rates, mirrored = car(*at(z)), car(*at(z * np.array([1, -1, -1, -1, 1])))
        np.testing.assert_allclose(mirrored, np.array(rates) * [1, -1, -1], atol=1e-12)


@pytest.mark.parametrize("name", CARS)
def test_coasting_loses_energy(name):
    config = load_vehicle(name)
    for z in samples(name):
        V, beta, r, delta = z[0], 0.3 * z[1], 0.3 * z[2], 0.3 * z[3]
        dx = config.build()(*at([V, beta, r, delta, 0.0]))
        power = config.m * V * dx.V + config.Iz * r * dx.r
        assert power <= 0


@pytest.mark.parametrize("name", CARS)
def test_standing_car_has_finite_rates_and_gradients(name):
    car = load_vehicle(name).build()
    x, u = at([0.0, 0.0, 0.0, 0.1, 1.0])
    assert all(np.isfinite(car(x, u)))
    jacobian = jax.jit(jax.jacfwd(lambda x, u: jnp.stack(car(x, u)), argnums=(0, 1)))(x, u)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jacobian))


def test_loads_carry_the_weight_and_balance_about_the_centre_of_mass():
    car = load_vehicle("sedan").build()
    np.testing.assert_allclose(car.Fzf + car.Fzr, 1835.0 * 9.81)
    np.testing.assert_allclose(car.Fzf * car.a, car.Fzr * car.b)


def test_gradients_match_central_differences():
    car = load_vehicle("sedan").build()
    f = jax.jit(lambda z: jnp.stack(car(State(*z[:3]), Control(*z[3:]))).sum())
    z = np.array([12.0, -0.4, 0.8, -0.2, 4000.0])
    step = 1e-5 * np.maximum(1.0, np.abs(z))
    central = [(float(f(z + h * e)) - float(f(z - h * e))) / (2 * h) for h, e in zip(step, np.eye(5), strict=True)]
    np.testing.assert_allclose(jax.grad(f)(z), central, rtol=1e-6, atol=1e-9)


def test_one_program_serves_every_parameter_set():
    rates = eqx.filter_jit(eqx.debug.assert_max_traces(lambda car, x, u: car(x, u), max_traces=1))
    cars: list[SingleTrack] = [load_vehicle(name).build() for name in CARS]
    first, second = (rates(car, *at([5.0, 0.1, 0.2, 0.1, 1.0])) for car in cars)
    assert float(first.r) != float(second.r)
