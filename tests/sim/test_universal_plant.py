"""The plant with effects: the nominal car where it has none, the car that was recorded, a mirror, laps and sensors."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import BadInput, Control, State, rk4_step
from driftjax.sim import LapCode, LapConfig, batch_of, drive, load_plants, plant_of
from driftjax.sim.record import Conditions, Manoeuvre, record
from driftjax.sim.sensors import SensorConfig
from driftjax.sim.universal_plant import UniversalPlant
from driftjax.track.build import from_curvature
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import EFFECTS

SEDAN = dataclasses.replace(load_vehicle("sedan"), combined_slip=1.0)
DT, SUBSTEPS, V0, LAP = 0.02, 20, 12.0, 50.0
EACH = [(effect.name, parameter) for effect in EFFECTS.values() for parameter in effect.parameters]
LATE = {"steer_lag": 0.08, "steer_delay": 0.05, "drive_lag": 0.1, "load_transfer_long": 0.3, "roll_lag": 0.1}


def plant(**values: float) -> UniversalPlant:
    """The sedan with these effects, SI, each in its first parameter."""
    theta = [values.get(name, 0.0) / p.scale(SEDAN) for name, p in EACH]
    return plant_of(SEDAN, np.array(theta), LAP, DT / SUBSTEPS)


@jax.jit
def driven(car: UniversalPlant, commands):
    """States and motions after each command (T, 2)."""

    def step(state, u):
        state = car.advance(state, Control(u[0], u[1]), DT, SUBSTEPS)
        return state, (state, car.motion(state, Control(u[0], u[1])))

    return jax.lax.scan(step, car.rolling(V0), commands)[1]


def wave(num=60) -> np.ndarray:
    """Steering to and fro under drive (num, 2), from rest."""
    t = DT * np.arange(num)
    return np.stack([0.12 * np.sin(5 * t), 4000 * np.sin(3 * t)], axis=1)


def test_without_effects_it_is_the_nominal_car_along_its_course():
    car, commands, h, fine = plant(), wave(), DT / SUBSTEPS, 4
    assert car.names == () and len(car.theta) == 0
    _, motion = driven(car, jnp.asarray(commands))

    def rates(z, u):
        dx = car.nominal(State(z[0], z[1], z[2]), Control(u[0], u[1]))
        course = z[5] + z[1]
        return jnp.stack([*dx, z[0] * jnp.cos(course), z[0] * jnp.sin(course), z[2]])

    def step(z, u):
        f = lambda z: rates(z, u)
        return (end := jax.lax.fori_loop(0, fine, lambda _, z: rk4_step(f, z, DT / fine), z)), end

    _, expected = jax.jit(lambda u: jax.lax.scan(step, jnp.zeros(6).at[0].set(V0), u))(jnp.asarray(commands))
    states = np.stack([motion.V, motion.beta, motion.r, motion.x, motion.y, motion.psi], axis=1)
    atol = np.array([1e-4, 1e-4, 1e-4, V0 * h, V0 * h, 1e-4])  # position: a step late in course
    assert (np.abs(states - expected) < atol).all()
    np.testing.assert_array_equal(motion.delta, commands[:, 0])


def test_it_moves_as_the_car_that_is_recorded():
    car, commands = plant(**LATE), jnp.asarray(wave())
    states, _ = driven(car, commands)
    x_ref = jnp.tile(jnp.array([V0, 0.0, 0.0]), (len(commands), 1))
    manoeuvre = Manoeuvre(x_ref, commands, jnp.zeros((2, 3)), jnp.asarray(LAP))
    silent = Conditions(jnp.zeros(3), jnp.zeros(3), jnp.asarray(1.0), jnp.zeros(3), jnp.asarray(1.0))
    wide = dataclasses.replace(SEDAN, delta_rate_max=100.0, Fxr_rate_max=1e7)  # the driver of a record is limited

    def run(model, manoeuvre):
        return record(model, wide, manoeuvre, silent, jax.random.key(0), DT, SUBSTEPS)

    log = jax.jit(run)(car.universal, manoeuvre)
    np.testing.assert_array_equal(log.command, commands)
    np.testing.assert_allclose(jnp.stack(states.x, axis=1)[:-1], log.x[1:], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(states.position[:-1], log.position[1:], rtol=1e-9, atol=1e-9)
    for one, other in zip(states.place, log.place, strict=True):
        np.testing.assert_allclose(one[:-1], other[1:], rtol=1e-9, atol=1e-9)
    assert float(states.place.s.max()) < float(states.distance[-1]) / LAP + 1 and float(states.place.heat[-1]) > 0


def test_what_turns_left_turns_right_in_the_mirror():
    car, commands = plant(**LATE), wave()
    (_, one), (_, other) = driven(car, jnp.asarray(commands)), driven(car, jnp.asarray(commands * [-1, 1]))
    sign = {"beta": -1, "r": -1, "y": -1, "psi": -1, "ay": -1, "delta": -1}
    for name in ("V", "beta", "r", "x", "y", "psi", "ax", "ay", "delta", "Fxr"):
        expected = sign.get(name, 1) * np.asarray(getattr(one, name))
        np.testing.assert_allclose(getattr(other, name), expected, rtol=1e-10, atol=1e-10)
    assert np.isnan(one.omega).all()


@pytest.mark.parametrize("effects", [{}, LATE], ids=["none", "late"])
def test_without_drive_tyres_only_dissipate(effects):
    steer = wave() * [3, 0]
    states, _ = driven(plant(**effects), jnp.asarray(steer))
    energy = SEDAN.m * states.x.V**2 + SEDAN.Iz * states.x.r**2
    assert (np.diff(energy) < 1e-9 * energy[0]).all() and energy[-1] < 0.99 * energy[0]


def test_sensors_tell_what_their_effects_make_of_the_motion():
    car = plant(gyro_bias=0.02)
    state = car.rolling(V0)
    motion = car.motion(state, Control(jnp.asarray(0.0), jnp.asarray(0.0)))
    readings = car.sensor_reading(state, motion)
    assert float(readings.r) == pytest.approx(0.02) and float(readings.V) == V0 and float(motion.r) == 0.0


def test_a_spinning_entry_keeps_its_code_and_the_others_continue():
    path, num = from_curvature([0.0, 20.0], [0.0, 0.0], 4.0, 81), 3
    fixed = jnp.array([[0.0, 0.0], [0.65, 7400.0], [np.nan, 0.0]])
    repeat = lambda tree: jax.tree.map(lambda a: jnp.broadcast_to(a, (num, *a.shape)) if eqx.is_array(a) else a, tree)
    policy = lambda sensed, memory, alive: (Control(memory[:, 0], memory[:, 1]), memory, alive)
    keys = jax.vmap(jax.random.key)(jnp.arange(num))
    config = LapConfig(time_limit=4.0, substeps=25)

    @jax.jit
    def laps(cars, paths):
        speed = jnp.full(num, 10.0)
        return drive(cars, paths, speed, policy, fixed, SensorConfig(), config, dt=0.05, keys=keys)

    result = laps(repeat(plant(**LATE, gyro_bias=0.02)), repeat(path))
    assert int(result.code[0]) == LapCode.COMPLETED and int(result.code[2]) == LapCode.NON_FINITE
    assert int(result.code[1]) in (LapCode.SPUN, LapCode.OFF_TRACK)
    assert int(result.trace.alive[0].sum()) * 0.05 == pytest.approx(2.0, abs=0.1)
    assert np.isfinite(np.asarray(result.trace.s[0])).all()
    alive = np.asarray(result.trace.alive[0])
    np.testing.assert_allclose((result.trace.sensed.r - result.trace.r)[0][alive], 0.02, atol=1e-12)


def test_a_late_sensor_tells_what_was():
    delays = {"d_V": 0.0, "d_beta": 0.013, "d_r": 0.0475}
    theta = [delays.get(p.name, 0.0) / p.scale(SEDAN) if name == "channel_delay" else 0.0 for name, p in EACH]
    car, commands = plant_of(SEDAN, np.array(theta), LAP, DT / SUBSTEPS), np.repeat(wave(8), SUBSTEPS, axis=0)

    def step(state, u):
        state = car.advance(state, Control(u[0], u[1]), DT / SUBSTEPS, 1)
        motion = car.motion(state, Control(u[0], u[1]))
        return state, (motion, car.sensor_reading(state, motion))

    _, (motion, readings) = jax.lax.scan(step, car.rolling(V0), jnp.asarray(commands))
    np.testing.assert_array_equal(readings.V, motion.V)
    np.testing.assert_allclose(readings.beta[13:], motion.beta[:-13], atol=1e-12)
    np.testing.assert_allclose(readings.r[48:], (motion.r[1:-47] + motion.r[:-48]) / 2, atol=1e-12)  # in between
    assert not np.any(readings.beta[:13]) and float(jnp.ptp(readings.beta)) > 1e-3  # it rolled straight on before


def test_plants_of_vehicle_files_are_the_cars_that_they_describe(tmp_path):
    """Also side by side with a car that lacks an effect of its neighbour."""
    (tmp_path / "late.yaml").write_text(
        "nominal: {base}\neffects: {steer_lag: {tau: 0.08}, friction: {p: -0.2}}\n".replace(
            "base", ", ".join(f"{key}: {value}" for key, value in dataclasses.asdict(SEDAN).items()
                              if key not in ("effects", "covariance", "noise"))))  # fmt: skip
    late, *_ = load_plants([tmp_path / "late.yaml"])
    batch = batch_of([late, SEDAN], LAP, DT / SUBSTEPS)
    assert isinstance(batch, UniversalPlant)
    assert batch.names == ("friction", "steer_lag") and batch.theta.shape == (2, 2)
    commands = jnp.asarray(wave())
    for entry, alone in enumerate((plant(steer_lag=0.08, friction=-0.2), plant())):
        _, motion = driven(jax.tree.map(lambda a, entry=entry: a[entry], batch), commands)
        _, expected = driven(alone, commands)
        np.testing.assert_allclose(motion.V, expected.V, rtol=1e-9)
        np.testing.assert_allclose(motion.r, expected.r, atol=1e-9)
    with pytest.raises(BadInput, match="give one kind"):
        load_plants([tmp_path / "late.yaml", "sedan"])
