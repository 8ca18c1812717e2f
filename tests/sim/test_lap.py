"""Laps: how each of them ends, frozen batch entries, batches against single laps, the same key the same lap."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.mpc import MPCConfig, Weights, drift_ocp, within_limits
from driftjax.control.pursuit import PursuitConfig, pure_pursuit
from driftjax.core import BadInput, Control
from driftjax.gp import zero_gp
from driftjax.sim import LapCode, LapConfig, drive, drive_laps
from driftjax.sim.lap import wrap
from driftjax.sim.sensors import SensorConfig, load_sensors
from driftjax.track.build import from_curvature
from driftjax.vehicle import load_plant, load_vehicle, no_residual, stack_plants

DT, SPEED = 0.05, 10.0
CAR = load_vehicle("sedan")
PATH = from_curvature([0.0, 20.0], [0.0, 0.0], 4.0, 81)
SENSORS = SensorConfig(0.05, 0.005, 0.01, 0.02, 0.02, 0.002)
CONFIG = LapConfig(time_limit=4.0, substeps=25)
STEER = pure_pursuit(PursuitConfig(), CAR)
OCP = drift_ocp(MPCConfig(horizon=1, dt=DT), Weights(), CAR, no_residual(zero_gp(4, 5, 3)))


def policy(sensed, memory, alive):
    """Pure pursuit within the limits, unless the entry's memory holds a command (finite) to apply instead."""
    command, fixed = memory
    steady = jnp.asarray(SPEED), jnp.asarray(0.0)
    each = jax.vmap(lambda x: jnp.stack(STEER(PATH, x.x, x.y, x.psi, x.V, x.r, x.s, *steady)))
    limited = jax.vmap(lambda u, before: within_limits(OCP, u[None], before, share=0.0)[0])
    u = jnp.where(jnp.isfinite(fixed), fixed, limited(each(sensed), command))
    return Control(u[:, 0], u[:, 1]), (u, fixed), alive


@eqx.filter_jit
def run(fixed, config, seeds, speed=SPEED):
    num = len(seeds)
    plants = stack_plants([load_plant("sedan")] * num)
    paths = jax.tree.map(lambda a: jnp.broadcast_to(a, (num, *a.shape)), PATH)
    keys = jax.vmap(jax.random.key)(seeds)
    memory = jnp.zeros((num, 2)), fixed
    return drive(plants, paths, jnp.full(num, speed), policy, memory, SENSORS, config, dt=DT, keys=keys)


PURSUE = [np.nan, np.nan]
FULL_LOCK = [0.65, 7400.0]


def lap(commands, seeds, **change):
    return run(jnp.asarray(commands), dataclasses.replace(CONFIG, **change), jnp.asarray(seeds))


@pytest.fixture(scope="module")
def pair():
    """Entry 0 follows the straight, entry 1 turns in with full lock and full throttle."""
    return lap([PURSUE, FULL_LOCK], [1, 2])


def test_pure_pursuit_completes_a_straight_in_the_time_it_takes(pair):
    trace = pair.trace
    assert int(pair.code[0]) == LapCode.COMPLETED
    driven = int(jnp.sum(trace.alive[0])) * DT
    assert driven == pytest.approx(20.0 / SPEED, abs=0.2)
    alive = np.asarray(trace.alive[0])
    assert np.max(np.abs(np.asarray(trace.e[0])[alive])) < 0.2
    assert np.all(np.diff(np.asarray(trace.s[0])[alive]) > 0)


def test_full_lock_and_throttle_ends_the_lap_and_freezes_only_its_own_entry(pair):
    assert int(pair.code[1]) in (LapCode.SPUN, LapCode.OFF_TRACK)
    alive = np.asarray(pair.trace.alive)
    ends = alive.sum(axis=1)
    assert np.all(np.diff(alive.astype(int), axis=1) <= 0)  # never alive again
    first, later = int(np.argmin(ends)), int(np.argmax(ends))
    assert ends[first] < ends[later]  # one entry is frozen while the other continues
    rest = slice(ends[first], ends[later])
    for name in ("x", "y", "psi", "V", "r", "s", "delta", "Fxr"):
        held = np.asarray(getattr(pair.trace, name))[first, rest]
        assert np.all(held == held[0])


def test_a_slow_lap_times_out():
    laps = lap([PURSUE, PURSUE], [1, 2], time_limit=0.3)
    assert [int(c) for c in laps.code] == [LapCode.TIMEOUT] * 2
    assert bool(jnp.all(laps.trace.alive)) and laps.trace.s.shape == (2, 6)  # although 0.3 / 0.05 < 6


def test_braking_to_a_halt_stalls():
    laps = lap([PURSUE, [0.0, -1.5e4]], [1, 2])
    assert [int(c) for c in laps.code] == [LapCode.COMPLETED, LapCode.STALLED]


def test_a_batch_equals_single_laps(pair):
    for i, (command, seed) in enumerate(zip([PURSUE, FULL_LOCK], [1, 2], strict=True)):
        single = lap([command], [seed])
        assert int(single.code[0]) == int(pair.code[i])
        alive = np.asarray(single.trace.alive[0])
        np.testing.assert_array_equal(alive, pair.trace.alive[i])
        for name in ("V", "beta", "r", "x", "y", "s", "e"):
            one, many = getattr(single.trace, name)[0], getattr(pair.trace, name)[i]
            np.testing.assert_allclose(np.asarray(one)[alive], np.asarray(many)[alive], atol=1e-6)


def test_the_same_keys_give_the_same_laps_and_others_do_not(pair):
    again, other = lap([PURSUE, FULL_LOCK], [1, 2]), lap([PURSUE, FULL_LOCK], [3, 2])
    for a, b in zip(jax.tree.leaves(pair), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(other.trace.sensed.V[0], pair.trace.sensed.V[0])
    driven = np.asarray(pair.trace.alive[1])  # an entry's noise does not depend on its neighbour's key
    np.testing.assert_array_equal(other.trace.alive[1], driven)
    np.testing.assert_array_equal(other.trace.sensed.V[1][driven], pair.trace.sensed.V[1][driven])


def test_laps_of_a_controller_of_ones_own_are_those_of_a_batch():
    """With the same noise, key by key; one speed serves all cars."""
    plants, fixed = [load_plant("sedan")] * 2, jnp.asarray([[0.0, -1.5e4], [0.02, 0.0]])
    hold = lambda sensed, memory, alive: (Control(fixed[:, 0], fixed[:, 1]), memory, alive)
    laps = drive_laps(plants, PATH, hold, SPEED, sensors="sedan", config=CONFIG, dt=DT, seed=3)
    paths = jax.tree.map(lambda a: jnp.broadcast_to(a, (2, *a.shape)), PATH)
    keys = jax.random.split(jax.random.key(3), 2)
    batch = drive(stack_plants(plants), paths, jnp.full(2, SPEED), hold, (), load_sensors("sedan"), CONFIG, dt=DT,
                  keys=keys)  # fmt: skip
    assert int(laps.code[0]) == LapCode.STALLED and laps.trace.V.shape[0] == 2
    for a, b in zip(jax.tree.leaves(laps), jax.tree.leaves(batch), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(BadInput, match="give one kind"):
        drive_laps([load_plant("sedan"), CAR], PATH, hold, SPEED)  # pyright: ignore[reportArgumentType]


def test_measurements_scatter_about_the_truth(pair):
    alive = np.asarray(pair.trace.alive[0])
    error = np.asarray(pair.trace.sensed.V[0] - pair.trace.V[0])[alive]
    assert 0 < np.std(error) < 3 * SENSORS.sigma_V


def test_wrapped_angles_lie_in_the_half_open_circle():
    angles = jnp.asarray([0.0, np.pi, -np.pi, 3.5, -3.5, 12 * np.pi + 0.1])
    np.testing.assert_allclose(wrap(angles), [0.0, np.pi, np.pi, 3.5 - 2 * np.pi, 2 * np.pi - 3.5, 0.1], atol=1e-12)


@pytest.mark.parametrize("delay", [0.04, 0.05, 0.07])
def test_commands_act_after_the_delay(delay):
    """Against the plant advanced by hand: no command first, then the one given, at once or within a step."""
    command, num = jnp.asarray([0.2, 3000.0]), 6
    plant = stack_plants([load_plant("sedan")])
    paths, keys = jax.tree.map(lambda a: a[None], PATH), jax.random.split(jax.random.key(0), 1)
    fixed = lambda sensed, memory, alive: (Control(command[:1], command[1:]), memory, alive)
    config = dataclasses.replace(CONFIG, time_limit=num * DT)
    sensors = dataclasses.replace(SENSORS, delay=delay)
    drive_it = eqx.filter_jit(
        lambda: drive(plant, paths, jnp.full(1, SPEED), fixed, (), sensors, config, dt=DT, keys=keys)
    )
    trace = drive_it().trace
    one = jax.tree.map(lambda a: a[0], plant)
    state, fine = one.rolling(SPEED, *(PATH.pose(0.0)[:3])), DT / CONFIG.substeps
    step = eqx.filter_jit(lambda x, u: one.advance(x, u, fine, 1))
    for k in range(num):
        np.testing.assert_allclose(trace.r[0, k], state.r, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(trace.delta[0, k], state.delta, rtol=1e-9, atol=1e-12)
        for i in range(CONFIG.substeps):
            acts = k * CONFIG.substeps + i >= round(delay / fine)
            state = step(state, Control(*(command * acts)))
    assert trace.delta[0, -1] > 0.01
