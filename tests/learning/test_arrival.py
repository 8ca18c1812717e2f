"""The state at the take-over: laps replace the plan's, noise averages out, a lap that ends early says nothing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.table import ReferenceTable
from driftjax.core import Control
from driftjax.learning import arrival
from driftjax.learning.arrival import Arrival
from driftjax.sim import Sensed, Trace

DT, LAGS = jnp.asarray(0.1), jnp.asarray([0.05, 0.2])
update_arrival = eqx.filter_jit(arrival.update_arrival)
PLANNED = Arrival(jnp.asarray([9.0, 0.0, 0.1, 0.0, 0.0]), jnp.zeros(2), jnp.zeros(2), jnp.asarray(0))


def update(before, trace, *args):
    return update_arrival(before, trace, trace.command, *args)


def lap(noise: float = 0.0, num: int = 40, seed: int = 0, until: int = 40) -> Trace:
    """Straight at 10 m/s and gaining, with constant commands; s = 10 t + 0.25 t^2."""
    t = 0.1 * np.arange(num)
    rng = np.random.default_rng(seed)
    values = {"V": 10 + 0.5 * t, "beta": 0.01 * t, "r": 0.2 - 0.1 * t, "e": 0.3 * t, "theta": -0.02 * t}
    noisy = {name: jnp.asarray(value + noise * rng.normal(size=num)) for name, value in values.items()}
    s, zero = jnp.asarray(10 * t + 0.25 * t**2), jnp.zeros(num)
    sensed = Sensed(noisy["V"], noisy["beta"], noisy["r"], zero, zero, zero, s, noisy["e"], noisy["theta"])
    command = Control(jnp.full(num, 0.1), jnp.full(num, 3000.0))
    alive = jnp.asarray(np.arange(num) < until)
    return Trace(
        alive=alive, sensed=sensed, V=zero, beta=zero, r=zero, x=zero, y=zero, psi=zero, s=zero, e=zero, delta=zero,
        Fxr=zero, command=command, decision=None,
    )  # fmt: skip


def at(s0: float) -> float:
    """Time at which the car is there."""
    return float((-10 + np.sqrt(100 + s0)) / 0.5)


@pytest.mark.parametrize("s0", [12.3, 20.0, 33.3])
def test_the_state_between_two_samples_is_found(s0):
    arrival, t = update(PLANNED, lap(), jnp.asarray(s0), LAGS, DT), at(s0)
    np.testing.assert_allclose(arrival.x, [10 + 0.5 * t, 0.01 * t, 0.2 - 0.1 * t, 0.3 * t, -0.02 * t], atol=2e-4)
    np.testing.assert_allclose(arrival.command, [0.1, 3000.0])
    lagged_input = 1 - np.exp(-t / np.asarray(LAGS))  # of commands held since the start
    np.testing.assert_allclose(arrival.lagged_input, lagged_input * [0.1, 3000.0], rtol=5e-3)
    assert int(arrival.laps) == 1


def test_laps_are_averaged_and_the_plan_is_forgotten():
    arrival, t = PLANNED, at(20.0)
    for seed in range(200):
        arrival = update(arrival, lap(noise=0.05, seed=seed), jnp.asarray(20.0), LAGS, DT)
    assert int(arrival.laps) == 200
    np.testing.assert_allclose(arrival.x[:3], [10 + 0.5 * t, 0.01 * t, 0.2 - 0.1 * t], atol=4 * 0.05 / np.sqrt(200))


def test_the_plan_has_the_types_of_laps_so_that_one_program_serves_both():
    """A weak type, which results of laps have not, made every program that takes it compile twice."""
    table = ReferenceTable(0.0, 5.0, *[jnp.zeros(9)] * 9, drift_start=20.0, drift_end=30.0)
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(arrival.planned_arrival(table, 2.0)))


def test_a_lap_that_ends_before_changes_nothing():
    arrival = update(PLANNED, lap(until=10), jnp.asarray(20.0), LAGS, DT)
    assert int(arrival.laps) == 0
    np.testing.assert_array_equal(arrival.x, PLANNED.x)
