"""Inverse dynamics: the car that is driven by its acceleration moves as the one driven by the force behind it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import Control, State
from driftjax.sim.rollout import move
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import default_catalogue
from driftjax.vehicle.effect.flow import Aux, Place
from driftjax.vehicle.single_track import G
from driftjax.vehicle.universal import Universal, universal_car

NUM = 40


@pytest.mark.parametrize("name", ["sedan", "rc"])
def test_the_force_behind_an_acceleration_is_that_of_the_car_with_its_effects(name):
    """In drifts, with less grip, a front drive share, air drag and more mass than the nominal car; nothing at rest."""
    vehicle, effects, zero = load_vehicle(name, combined_slip=1.0), default_catalogue(), jnp.zeros(())
    hidden = {"friction": -2.0, "drive_split": 1.0, "aero_drag": 2.0, "mass": 1.0}
    theta = jnp.asarray([hidden.get(effect.name, 0.0) for effect in effects for _ in effect.parameters])
    driven, inverse = (
        universal_car(vehicle, effects, by_acceleration=by).with_parameters(theta) for by in (False, True)
    )
    place, aux = Place(zero, zero, zero, zero), Aux(jnp.zeros(2), zero)
    draw = np.random.default_rng(0).uniform
    V, beta = np.sqrt(G * (vehicle.a + vehicle.b)) * draw(2, 4, NUM), draw(0.1, 0.4, NUM)
    r, delta, F = -0.5 * vehicle.mu * G / V, draw(0.0, 0.4, NUM), draw(-0.2, 0.3, NUM) * vehicle.mu * vehicle.m * G

    def both(V, beta, r, delta, F):
        x = State(V, beta, r)
        expected = driven.rates(x, Control(delta, F), place, aux)
        u = Control(delta, vehicle.m * expected.V)
        return (
            jnp.stack(expected),
            jnp.stack(inverse.rates(x, u, place, aux)),
            inverse.flow(x, u, place, aux).u.Fxr,
        )

    expected, rates, force = jax.vmap(both)(*map(jnp.asarray, (V, beta, r, delta, F)))
    most = vehicle.mu * vehicle.m * G
    np.testing.assert_allclose(force, F, atol=1e-4 * most)
    np.testing.assert_allclose(rates, expected, atol=2e-4 * float(np.abs(expected).max()))
    beta_, r_, delta_, F_ = (jnp.asarray(value) for value in (0.4, -0.5, 0.1, 0.1 * most))
    speed_rate = lambda V: inverse.rates(State(V, beta_, r_), Control(delta_, F_), place, aux).V
    slope = jax.jacfwd(speed_rate)(jnp.asarray(5.0))
    assert abs(float(slope)) < 1e-3  # the speed follows the measurement, whatever the speed
    yaw = lambda car, u: lambda theta: car.with_parameters(theta).rates(State(V_, beta_, r_), u(theta), place, aux).r
    V_, held = jnp.asarray(5.0), Control(delta_, F_)
    force_of = lambda t: inverse.with_parameters(t).flow(State(V_, beta_, r_), held, place, aux).u
    near = [yaw(driven, force_of)(theta.at[0].add(h)) for h in (1e-4, -1e-4)]
    by_friction = jax.jacfwd(yaw(inverse, lambda _: held))(theta)[0]
    np.testing.assert_allclose(by_friction, (near[0] - near[1]) / 2e-4, rtol=0.02)


@pytest.mark.parametrize("name", ["sedan", "rc"])
def test_the_force_follows_the_acceleration_through_a_step(name, monkeypatch):
    """Each evaluation begins at the force of the one before: as good as to solve for it every time."""
    vehicle, effects, zero = load_vehicle(name, combined_slip=1.0), default_catalogue(), jnp.zeros(())
    car = universal_car(vehicle, effects, by_acceleration=True)
    place, draw = Place(zero, zero, zero, zero), np.random.default_rng(1).uniform
    V, beta = np.sqrt(G * (vehicle.a + vehicle.b)) * draw(2, 4, NUM), draw(0.1, 0.4, NUM)
    r, delta, most = -0.5 * vehicle.mu * G / V, draw(0.0, 0.4, NUM), vehicle.mu * vehicle.m * G
    F, rise = most * draw(-0.2, 0.3, NUM), most * draw(-0.05, 0.05, NUM)

    def after(V, beta, r, delta, F, rise):
        z, u = jnp.stack([V, beta, r, zero, zero, zero]), jnp.stack([delta, F, 0.01 + zero, rise])
        return move(car, z, u, place, jnp.asarray(0.01)).z

    inputs = tuple(map(jnp.asarray, (V, beta, r, delta, F, rise)))
    followed, flow = jax.vmap(after)(*inputs), Universal.flow
    monkeypatch.setattr(Universal, "flow", lambda self, x, u, place, aux, near: flow(self, x, u, place, aux))
    solved = jax.vmap(after)(*inputs)
    error, moved = np.abs(followed - solved)[:, 2], np.abs(solved[:, 2] - r).mean()
    assert 0 < np.quantile(error, 0.9) < 1e-3 * moved
    assert error.max() < 0.1 * moved  # where the drive takes all grip of the rear tyres


def test_effects_of_the_drive_leave_a_measured_acceleration_alone():
    vehicle, effects = load_vehicle("rc"), default_catalogue()
    theta = jnp.asarray([1.0 if e.name in ("drive_gain", "drive_lag") else 0.0 for e in effects for _ in e.parameters])
    car = universal_car(vehicle, effects, by_acceleration=True).with_parameters(theta)
    _, u = car.apply_actuators(car.start(0.01), Control(jnp.asarray(0.1), jnp.asarray(3.0)), jnp.asarray(2.0), 0.01)
    assert float(u.Fxr) == 3.0
