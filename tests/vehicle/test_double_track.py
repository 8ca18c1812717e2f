"""Plant: symmetry, energy, limits, standstill, steady drifts and gradients."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drift_state import drift_state
from plant_runs import drive, energy, last, run

from driftjax.core import Control
from driftjax.vehicle import DoubleTrack, draw_plants, load_plant, load_vehicle, stack_plants

CARS = ["sedan", "rc"]
SPEED = {"sedan": 12.0, "rc": 2.5}
STEP = {"sedan": 0.01, "rc": 0.005}  # of the command; the substep is a tenth
NUM = 200
FLIP = np.array([1, 0, 3, 2])  # left and right wheels exchanged


def commands(name, seed=0, num=NUM):
    """Piecewise constant commands that use most of the car's range."""
    config = load_vehicle(name)
    rng = np.random.default_rng(seed)
    delta = rng.uniform(-config.delta_max, config.delta_max, num // 20).repeat(20)
    return delta, rng.uniform(config.Fxr_min, config.Fxr_max, num // 20).repeat(20)


def sliding(car: DoubleTrack, V, beta, r):
    """State that moves at sideslip `beta` and yaw rate `r` with wheels at their rolling speed."""
    start = car.rolling(V * np.cos(beta))
    return start._replace(vy=V * np.sin(beta), r=jnp.asarray(r, float))


def mirrored(state):
    turned = state._replace(y=-state.y, psi=-state.psi, vy=-state.vy, r=-state.r, delta=-state.delta, roll=-state.roll)
    swap = lambda leaf: leaf[..., FLIP]
    return turned._replace(omega=swap(state.omega), kappa=swap(state.kappa), alpha=-swap(state.alpha))


@pytest.mark.parametrize("name", CARS)
def test_mirrored_commands_drive_the_mirrored_path(name):
    car = load_plant(name).build()
    delta, Fxr = commands(name)
    start = sliding(car, SPEED[name], -0.3, 0.5)
    left, _ = run(car, start, delta, Fxr, STEP[name])
    right, _ = run(car, mirrored(start), -delta, Fxr, STEP[name])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6), mirrored(left), right)


@pytest.mark.parametrize("name", CARS)
@pytest.mark.parametrize("beta", [0.1, -1.05, -1.5, 2.5])
def test_coasting_gains_no_energy_at_any_sideslip(name, beta):
    """A relaxing tyre gives back what its carcass stored: at most 1 % of the energy at the start, and the less the
    shorter the relaxation length.
    """
    config = load_plant(name)
    for share, regained in ((1.0, 0.01), (0.25, 0.0025)):
        car = dataclasses.replace(
            config, relaxation=share * config.relaxation, relaxation_long=share * config.relaxation_long
        ).build()
        start = sliding(car, SPEED[name], beta, 0.08 * SPEED[name])
        states, _ = run(car, start, commands(name)[0], np.zeros(NUM), STEP[name])
        history = np.append(energy(car, start), energy(car, states)) / energy(car, start)
        assert np.all(np.isfinite(history))
        assert (history - np.minimum.accumulate(history)).max() <= regained
        assert history[-1] < 0.9


@eqx.filter_jit
def _forces(car, states):
    force = jax.vmap(car.forces)(states)
    return force, car.tyre.friction(force.Fz, car.chassis.static_loads()), car.forces(car.rolling(1.0))


@pytest.mark.parametrize("name", CARS)
def test_forces_stay_in_the_friction_circle_and_loads_carry_the_weight(name):
    car = load_plant(name).build()
    states, _ = run(car, sliding(car, SPEED[name], -0.4, 0.8), *commands(name, seed=1), STEP[name])
    force, friction, alone = jax.device_get(_forces(car, states))
    limit, total = friction * force.Fz, np.hypot(force.Fx, force.Fy)
    assert np.all(total <= limit * (1 + 1e-9))
    assert (total / limit).max() > 0.99
    weight = float(car.chassis.m * 9.81)
    np.testing.assert_allclose(alone.Fz.sum(), weight, rtol=2e-4)
    assert force.Fz.min() > 0
    np.testing.assert_allclose(force.Fz.sum(-1), weight, rtol=0.01)  # smoothing near lift-off adds the most


def test_load_transfer_is_the_moment_balance():
    car = load_plant("sedan").build()
    chassis = car.chassis
    state = car.rolling(10.0)._replace(pitch=jnp.asarray(2.0), roll=jnp.asarray(4.0))
    Fz = np.asarray(eqx.filter_jit(car.forces)(state).Fz)
    L = chassis.a + chassis.b
    moved = (Fz[2] + Fz[3]) - chassis.m * 9.81 * chassis.a / L
    np.testing.assert_allclose(moved, chassis.m * 2.0 * chassis.h / L, rtol=2e-3)
    roll = (Fz[1] - Fz[0]) * chassis.track_f / 2 + (Fz[3] - Fz[2]) * chassis.track_r / 2
    np.testing.assert_allclose(roll, chassis.m * 4.0 * chassis.h, rtol=1e-3)


@pytest.mark.parametrize("name", CARS)
def test_free_rolling_goes_straight_and_without_losses_keeps_its_speed(name):
    config = load_plant(name)
    free = dataclasses.replace(config, drag=0.0, rolling_resistance=0.0).build()
    V, heading = SPEED[name], 0.7
    end, motion = run(free, free.rolling(V, x=1.0, y=2.0, psi=heading), np.zeros(NUM), np.zeros(NUM), STEP[name])
    np.testing.assert_allclose(motion.V, V, rtol=1e-9)
    travelled = V * STEP[name] * NUM
    np.testing.assert_allclose(end.x[-1], 1.0 + travelled * np.cos(heading), rtol=1e-9)
    np.testing.assert_allclose(end.y[-1], 2.0 + travelled * np.sin(heading), rtol=1e-9)

    slowed, motion = run(config.build(), free.rolling(V), np.zeros(NUM), np.zeros(NUM), STEP[name])
    np.testing.assert_allclose(slowed.y, 0.0, atol=1e-12)
    loss = config.rolling_resistance * 9.81 + config.drag * V**2 / config.m
    np.testing.assert_allclose(motion.ax[20:60].mean(), -loss, rtol=0.1)  # the spinning masses coast along


def test_small_slip_without_load_transfer_is_the_linear_bicycle():
    config = dataclasses.replace(
        load_plant("sedan"), h=0.0, drag=0.0, rolling_resistance=0.0, diff_coupling=0.0, diff_preload=0.0,
        diff_bias=0.0, mur=1.1, E=0.0,
    )  # fmt: skip
    car = config.build()
    angle = 0.002
    _, motion = run(car, car.rolling(15.0), np.full(NUM, angle), np.zeros(NUM), STEP["sedan"])
    V, L = float(motion.V[-1]), config.a + config.b
    front = config.muf * config.Bf * config.C * config.m * 9.81 * config.b / L
    rear = config.mur * config.Br * config.C * config.m * 9.81 * config.a / L
    understeer = config.m / L * (config.b / front - config.a / rear)
    np.testing.assert_allclose(motion.r[-1], angle * V / (L + understeer * V**2), rtol=2e-3)


@pytest.mark.parametrize("name", CARS)
def test_braking_stops_the_car_and_turns_no_wheel_backwards(name):
    config = load_plant(name)
    car = config.build()
    state = car.rolling(0.7 * SPEED[name])
    rim, motion = [], car.motion(state, Control(state.delta, state.drive))
    for _ in range(3):
        states, motion = run(car, state, np.zeros(NUM), np.full(NUM, config.Fxr_min), STEP[name])
        state = last(states)
        rim.append(states.omega * config.wheel_radius)
    rim = np.concatenate(rim)
    assert rim[:, 2:].min() > -0.2 * config.creep_speed
    assert float(np.ravel(motion.V)[-1]) < 0.03 * SPEED[name]
    assert np.isfinite(rim).all()


@pytest.mark.parametrize("name", CARS)
def test_car_starts_from_rest_with_finite_gradients(name):
    config = load_plant(name)
    car = config.build()
    num = NUM
    push = 0.2 * config.m * 9.81
    states, motion = run(car, car.rolling(0.0), np.full(num, 0.05), np.full(num, push), STEP[name])
    duration = num * STEP[name]
    assert 0.5 < float(motion.V[-1]) / (0.2 * 9.81 * (duration - config.drive_lag)) < 1.0  # wheels take their part
    assert float(states.psi[-1]) > 0
    speed = lambda z: run(car, car.rolling(z[0]), jnp.full(num, z[1]), jnp.full(num, z[2]), STEP[name])[1].V[-1]
    slope = jax.grad(speed)(np.array([0.0, 0.05, push]))
    assert np.isfinite(slope).all() and float(slope[2]) > 0
    at_rest = jax.jit(jax.grad(lambda V: sum(car.motion(car.rolling(V), Control(V, V))[:3])))(0.0)
    assert np.isfinite(at_rest)


def test_differential_coupling_leads_from_open_to_locked():
    """Steady left turn: the difference of the rear wheels falls from the kinematic one towards none."""
    base = dataclasses.replace(load_plant("sedan"), diff_preload=0.0, diff_bias=0.0)
    shares = []
    for coupling in (0.0, 100.0, 1000.0):
        car = dataclasses.replace(base, diff_coupling=coupling).build()
        states, motion = run(car, car.rolling(8.0), np.full(NUM, 0.1), np.full(NUM, 500.0), STEP["sedan"])
        kinematic = motion.r[-1] * base.track_r / base.wheel_radius
        shares.append(float((states.omega[-1, 3] - states.omega[-1, 2]) / kinematic))
    np.testing.assert_allclose(shares[0], 1.0, atol=0.03)
    assert shares[0] > shares[1] > shares[2]
    assert shares[2] < 0.35


@pytest.mark.parametrize("name", CARS)
def test_actuators_keep_lag_rate_range_and_power(name):
    config, dt = load_plant(name), STEP[name]
    car = config.build()
    num = NUM
    states, motion = run(car, car.rolling(SPEED[name]), np.full(num, 9.0), np.full(num, 1e6), dt)
    np.testing.assert_allclose(states.delta[-1], config.delta_max, rtol=1e-3)
    np.testing.assert_allclose(states.drive[-1], config.Fxr_max, rtol=1e-3)
    assert np.diff(np.asarray(states.delta), prepend=0.0).max() <= config.delta_rate_max * dt * (1 + 1e-9)
    assert np.diff(np.asarray(states.drive), prepend=0.0).max() <= config.Fxr_rate_max * dt * (1 + 1e-9)
    rim = config.wheel_radius * states.omega[:, 2:].mean(-1)
    assert bool(jnp.all(motion.Fxr * rim <= config.power_max * (1 + 1e-9)))

    small = 1e-3  # below the rate limits the approach is exponential
    states, _ = run(car, car.rolling(SPEED[name]), np.full(num, small), np.zeros(num), dt)
    time = dt * np.arange(1, num + 1)
    np.testing.assert_allclose(states.delta, small * (1 - np.exp(-time / config.steer_lag)), atol=1e-9)


def test_power_limit_bites_at_speed():
    config = dataclasses.replace(load_plant("sedan"), power_max=50e3)
    car = config.build()
    _, motion = run(car, car.rolling(20.0), np.zeros(NUM), np.full(NUM, 6000.0), STEP["sedan"])
    rim = config.wheel_radius * motion.omega[-1, 2:].mean()
    np.testing.assert_allclose(motion.Fxr[-1] * rim, 50e3, rtol=1e-3)


@pytest.mark.parametrize("name", CARS)
def test_motion_is_the_state_as_sensors_see_it(name):
    car = load_plant(name).build()
    states, motion = run(car, sliding(car, SPEED[name], -0.4, 0.5), *commands(name, seed=2), STEP[name])
    np.testing.assert_allclose(motion.V * np.cos(motion.beta), states.vx, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(motion.V * np.sin(motion.beta), states.vy, rtol=1e-9, atol=1e-6)
    rates = jax.jit(jax.vmap(lambda s: car.rates(s, Control(s.delta, s.drive))))(states)
    np.testing.assert_allclose(motion.ax, rates.vx - states.r * states.vy, atol=1e-9)
    np.testing.assert_allclose(motion.ay, rates.vy + states.r * states.vx, atol=1e-9)


@pytest.mark.parametrize("name", CARS)
def test_steady_drift_is_within_reach_of_the_commands(name):
    """Left turn at beta -25 deg on the paper's radius, presets and sampled plants: countersteer, force in hand."""
    limits = load_vehicle(name)
    radius = {"sedan": 15.0, "rc": 1.0}[name]
    presets = {"sedan": ["sedan", "sedan_mu12", "sedan_front_bias"], "rc": ["rc", "rc_mu085", "rc_mu110"]}[name]
    for config in [load_plant(preset) for preset in presets] + draw_plants(name, 4, seed=0):
        car = config.build()
        state, left = drift_state(car, np.deg2rad(-25.0), radius)
        assert left < 1e-6
        assert -limits.delta_max < float(state.delta) < 0
        assert 0 < float(state.drive) < 0.98 * limits.Fxr_max
        grip = float(state.vx**2 + state.vy**2) / radius / 9.81 / config.mur
        assert 0.75 < grip < 0.95


def test_steady_drift_holds_in_the_simulation():
    car = load_plant("sedan").build()
    state, _ = drift_state(car, np.deg2rad(-25.0), 15.0)
    _, motion = run(car, state, np.full(NUM, state.delta), np.full(NUM, state.drive), 0.0025)
    np.testing.assert_allclose(motion.beta, np.deg2rad(-25.0), atol=1e-5)
    np.testing.assert_allclose(motion.V, motion.V[0], rtol=1e-5)


@pytest.mark.slow
def test_gradients_through_a_rollout_match_central_differences():
    car = load_plant("sedan").build()
    state, _ = drift_state(car, np.deg2rad(-25.0), 15.0)

    @jax.jit
    def outcome(z):
        plant = eqx.tree_at(lambda p: (p.tyre.mu, p.chassis.h), car, (car.tyre.mu * z[2], car.chassis.h * z[3]))
        num = 20
        end, _ = drive(plant, state._replace(vx=state.vx * z[4]), jnp.full(num, state.delta + 0.02 * z[0]),
                       jnp.full(num, state.drive * z[1]), 0.01)  # fmt: skip
        return end.y[-1] + end.vy[-1] + 10 * end.r[-1]

    z, step = np.ones(5), 1e-5
    central = [(float(outcome(z + step * e)) - float(outcome(z - step * e))) / (2 * step) for e in np.eye(5)]
    np.testing.assert_allclose(jax.jit(jax.grad(outcome))(z), central, rtol=1e-5, atol=1e-6)


def test_integration_is_of_fourth_order():
    """Error at 0.2 s of a smooth manoeuvre against a far finer step; halving the step divides it by 16."""
    car = load_plant("sedan").build()
    state, _ = drift_state(car, np.deg2rad(-15.0), 30.0)
    command = Control(state.delta + 0.02, state.drive + 500.0)
    end = eqx.filter_jit(lambda num: car.advance(state, command, 0.2, num).vy)
    exact = end(1600)
    errors = [abs(float(end(num) - exact)) for num in (100, 200)]
    assert 3.5 < np.log2(errors[0] / errors[1]) < 4.6


@pytest.mark.parametrize(("name", "speeds"), [("sedan", (2.0, 12.0, 40.0)), ("rc", (0.5, 3.0, 8.0))])
def test_working_step_is_stable_and_near_a_finer_one(name, speeds):
    """Substeps of 1 ms (sedan) and 0.5 ms (RC) against a quarter of that, gentle steering at three speeds."""
    config = load_plant(name)
    car, dt = config.build(), STEP[name]
    delta, Fxr = 0.05 * np.sin(np.arange(NUM) * dt * 6), np.full(NUM, 0.2 * config.Fxr_max)
    for V in speeds:
        coarse, _ = run(car, car.rolling(V), delta, Fxr, dt)
        state = car.rolling(V)
        for part in np.split(delta.repeat(4), 4):
            state = last(run(car, state, part, Fxr, dt / 4)[0])
        np.testing.assert_allclose(coarse.y[-1], state.y, atol=1e-4 * V)
        np.testing.assert_allclose(coarse.omega[-1], state.omega, rtol=1e-4)


@pytest.mark.parametrize(("name", "fastest"), [("sedan", 40.0), ("rc", 8.0)])
def test_no_command_breaks_a_sampled_plant(name, fastest):
    """Full throttle, full brake and full-range commands, from rest and from high speed, spins included."""
    limits = load_vehicle(name)
    delta, Fxr = commands(name, seed=4)
    for config in draw_plants(name, 3, seed=2):
        car = config.build()
        for V in (0.0, fastest):
            for force in (np.full(NUM, limits.Fxr_max), np.full(NUM, limits.Fxr_min), Fxr):
                states, _ = run(car, car.rolling(V), delta, force, STEP[name])
                assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(states))
                gained = energy(car, last(states)) - energy(car, car.rolling(V))
                assert float(gained) <= config.power_max * NUM * STEP[name]


def test_batch_of_plants_equals_single_runs_with_one_trace():
    plants = draw_plants("sedan", 3, seed=1)
    batch = stack_plants(plants)
    counted = eqx.filter_jit(eqx.debug.assert_max_traces(drive, max_traces=1))
    delta, Fxr = commands("sedan")
    starts = jax.jit(jax.vmap(lambda car: car.rolling(12.0)))(batch)
    together, _ = eqx.filter_jit(eqx.filter_vmap(drive, in_axes=(0, 0, None, None, None)))(
        batch, starts, delta, Fxr, 0.01
    )
    for entry, config in enumerate(plants):
        car = config.build()
        alone, _ = counted(car, car.rolling(12.0), delta, Fxr, 0.01)
        np.testing.assert_allclose(together.y[entry], alone.y, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(together.omega[entry], alone.omega, rtol=1e-6, atol=1e-6)
