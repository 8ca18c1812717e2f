"""The catalogue's contract: neutral exactly the nominal car, live finite derivatives, and equations done by hand."""

import functools
import operator
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import BadInput, Control, State
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import EFFECTS, Place, default_catalogue, reference
from driftjax.vehicle.effect.flow import ROLL_GRIP, Aux
from driftjax.vehicle.single_track import G
from driftjax.vehicle.universal import Universal, universal_car

NAMES = (
    "friction friction_front friction_rear stiffness_front stiffness_rear tyre_shape sliding_friction load_sensitivity "
    "load_transfer_long load_transfer_lat combined_slip relaxation_length aero_drag rolling_resistance downforce "
    "engine_drag drive_gain drive_lag power_limit wheel_spin differential_moment torque_vectoring mass yaw_inertia "
    "cog_shift roll_lag roll_steer steer_offset steer_gain steer_compliance steer_lag steer_delay steer_backlash "
    "road_bank road_grade side_wind friction_patch friction_fade gyro_bias gyro_scale sideslip_bias speed_scale "
    "channel_delay imu_lever_arm drive_split yaw_moment traction_limit brake_split track_width tyre_curve_front "
    "tyre_curve_rear"
).split()
OWNER = [effect.name for effect in EFFECTS.values() for _ in effect.parameters]
BOUNDS = np.array([(p.lower, p.upper) for effect in EFFECTS.values() for p in effect.parameters])
CASES = {"sedan": 0.0, "rc": 1.0}  # combined slip: none, and a circle
DT, NUM, STEP = 0.01, 24, 1e-4
STILL = Place(*map(jnp.asarray, (0.0, 0.0, 0.0, 0.0)))
NONE = Aux(jnp.zeros(2), jnp.zeros(()))


def vehicle_of(name, combined_slip):
    return replace(load_vehicle(name), combined_slip=combined_slip)


@functools.cache
def all_effects(name, combined_slip) -> Universal:
    return universal_car(vehicle_of(name, combined_slip), tuple(EFFECTS.values()))


@functools.cache
def batch(name):
    """Rich states, commands, places and rates: grip and slides, both turns, drive, coasting and braking."""
    vehicle, rng = load_vehicle(name), np.random.default_rng(3)
    between = lambda low, high: jnp.asarray(rng.uniform(low, high, NUM))
    speed, rate, force = (reference(vehicle, of) for of in ("speed", "yaw_rate", "force"))
    x = State(speed * between(0.5, 3), between(-0.6, 0.6), rate * between(-0.6, 0.6))
    u = Control(between(-0.4, 0.4), force * between(-0.2, 0.3))
    u = u._replace(Fxr=u.Fxr.at[0].set(0.0))
    place = Place(between(0, 60), between(-3, 3), jnp.linspace(0, 1, NUM), between(0.05, 0.3))
    return x, u, place, State(*(rate * q * between(-0.5, 0.5) for q in (speed, 1.0, rate)))


def outputs(model, x, u, place, dx):
    """All that effects can change: rates, measured states, what actuators make of commands, lags of the roll-out."""
    lag = Aux(jnp.zeros((2, NUM)), jnp.zeros(NUM))
    step = lambda memory, row: model.apply_actuators(memory, Control(row[0], row[1]), row[2], DT)
    acted = jax.lax.scan(step, model.start(DT), (u.delta, u.Fxr, x.V))[1]
    car = jnp.stack([model.car.relaxation, model.car.roll_lag])
    parts = (model.rates(x, u, place, lag), model.sense(x, dx), acted, car)
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(parts)])


@eqx.filter_jit
def along(model, thetas, data):
    """Outputs (K, D) at each row of `thetas` and their derivative by the parameter of that row."""
    at = lambda theta: outputs(model.with_parameters(theta), *data)
    return jax.vmap(lambda theta, d: jax.jvp(at, (theta,), (d,)))(thetas, jnp.eye(len(model.theta)))


@eqx.filter_jit
def backward(model, thetas, data):
    """Gradients of the summed outputs by parameters, states and commands, in reverse mode, for each row."""

    def total(theta, x, u):
        return jnp.sum(outputs(model.with_parameters(theta), x, u, *data[2:]))

    return jax.lax.map(lambda theta: jax.grad(total, argnums=(0, 1, 2))(theta, *data[:2]), thetas)


@functools.cache
def derivatives(name):
    """Derivatives at neutral (K, D) and forward differences of a ten-thousandth of the typical sizes."""
    model, data = all_effects(name, CASES[name]), batch(name)
    eye = np.eye(len(OWNER))
    y0, exact = along(model, jnp.zeros_like(eye), data)
    y1, _ = along(model, jnp.asarray(STEP * eye), data)
    return np.asarray(exact), (np.asarray(y1) - np.asarray(y0)) / STEP


@functools.cache
def extremes(name, standing, differentiate):
    """Whether outputs and derivatives are finite (K,) at plus and minus one typical size."""
    model, data = all_effects(name, CASES[name]), batch(name)
    if standing:
        data = jax.tree.map(jnp.zeros_like, data)
    good = np.ones(len(OWNER), bool)
    for sign in (1, -1):
        thetas = jnp.asarray(np.clip(sign * np.eye(len(OWNER)), BOUNDS[:, 0], BOUNDS[:, 1]))
        for leaf in jax.tree.leaves(differentiate(model, thetas, data)):
            good &= np.isfinite(leaf).reshape(len(OWNER), -1).all(axis=1)
    return good


def rows(effect):
    return np.flatnonzero(np.array(OWNER) == effect)


def car_with(car="sedan", **values_of) -> Universal:
    """The car with these effects at these values, SI."""
    model = universal_car(load_vehicle(car), tuple(effect for name, effect in EFFECTS.items() if name in values_of))
    values = np.concatenate([np.atleast_1d(values_of[effect.name]) for effect in model.effects])
    return model.with_parameters(jnp.asarray(values) / model.scale)


def state(V=10.0, beta=0.0, r=0.0):
    return State(*map(jnp.asarray, (V, beta, r)))


def control(delta=0.0, Fxr=0.0):
    return Control(jnp.asarray(delta), jnp.asarray(Fxr))


def gain(model, x, u, place=STILL, aux=NONE):
    """Rates beyond the nominal car's."""
    return np.array(model.rates(x, u, place, aux)) - np.array(load_vehicle("sedan").build()(x, u))


def acted(model, commands, V=10.0):
    """Steering angles and drive forces that the actuators make of rows (delta, Fxr)."""
    memory, inputs = model.start(DT), []
    for row in commands:
        memory, u = model.apply_actuators(memory, control(*row), jnp.asarray(V), DT)
        inputs.append(u)
    return np.array(inputs)


def test_every_canonical_name_is_there_with_its_number():
    assert {name: effect.number for name, effect in EFFECTS.items()} == {n: i + 1 for i, n in enumerate(NAMES)}
    assert list(EFFECTS) == NAMES


def test_a_diagnosis_looks_for_effects_on_request_where_they_are_named():
    usual = [effect.name for effect in default_catalogue()]
    assert [name for name in EFFECTS if name not in usual] == ["tyre_curve_front", "tyre_curve_rear"]
    assert [effect.name for effect in default_catalogue("tyre_curve_rear")] == [*usual, "tyre_curve_rear"]
    with pytest.raises(BadInput, match="'tyre_curve': no such effect"):
        default_catalogue("tyre_curve")


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=list(EFFECTS))
def test_parameters_are_described(effect):
    assert effect.source and effect.sentence and not effect.sentence.endswith(".")
    assert len({p.name for p in effect.parameters}) == len(effect.parameters) > 0
    for p in effect.parameters:
        assert p.name and p.unit and p.typical > 0 and p.lower <= 0 < p.upper
        assert all(p.scale(load_vehicle(car)) > 0 for car in CASES)
    assert set(effect.needs) <= {"psi", "s"}


@pytest.mark.parametrize("combined_slip", [0.0, 1.0])
@pytest.mark.parametrize("name", CASES)
def test_neutral_is_the_nominal_car_to_the_last_bit(name, combined_slip):
    model, nominal = all_effects(name, combined_slip), vehicle_of(name, combined_slip).build()
    for i in range(0, NUM, 3):  # one by one: batched, a division by a scalar is compiled as a product
        x, u, place, dx = jax.tree.map(operator.itemgetter(i), batch(name))
        np.testing.assert_array_equal(model.rates(x, u, place, NONE), nominal(x, u))
        np.testing.assert_array_equal(model.sense(x, dx), x)
    commands = np.stack(batch(name)[1], axis=1)[:8]
    np.testing.assert_array_equal(acted(model, commands), commands)


@pytest.mark.parametrize("effect", [name for name, effect in EFFECTS.items() if effect.station != "command"])
def test_an_effect_alone_acts_as_in_the_whole_catalogue(effect, name="sedan"):
    """Body accelerations are computed only where an effect reads them: none that does may have been forgotten."""
    (x, u, place, _), behind = batch(name), Aux(jnp.full((2, NUM), 0.01), jnp.zeros(NUM))
    whole, alone = all_effects(name, 1.0), universal_car(vehicle_of(name, 1.0), (EFFECTS[effect],))
    theta = jnp.zeros_like(whole.theta).at[rows(effect)].set(0.5)
    alone = alone.with_parameters(theta[rows(effect)])
    expected = whole.with_parameters(theta).rates(x, u, place, behind)
    np.testing.assert_allclose(alone.rates(x, u, place, behind), expected, rtol=1e-9)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("effect", EFFECTS)
def test_derivatives_at_neutral_are_alive_and_match_forward_differences(effect, name):
    exact, differences = (derivative[rows(effect)] for derivative in derivatives(name))
    assert np.isfinite(exact).all()
    largest = np.abs(exact).max(axis=1, keepdims=True)
    assert (largest > 0).all()
    np.testing.assert_allclose(exact / largest, differences / largest, atol=1e-3)


@pytest.mark.parametrize("standing", [False, True], ids=["moving", "standing"])
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    "differentiate", [along, pytest.param(backward, marks=pytest.mark.slow)], ids=["forward", "reverse"]
)
def test_nothing_is_nan_at_typical_sizes(name, standing, differentiate):
    assert [OWNER[i] for i in np.flatnonzero(~extremes(name, standing, differentiate))] == []


def test_drag_pulls_against_the_velocity():
    change = gain(car_with(aero_drag=0.7), state(20.0, 0.3, 0.2), control(0.1, 1000.0))
    np.testing.assert_allclose(change, [-0.7 * 400 / 1835, 0, 0], atol=1e-12)


def test_bank_pulls_to_the_left():
    change = gain(car_with(road_bank=0.05), state(20.0), control())
    np.testing.assert_allclose(change, [0, G * np.sin(0.05) / 20, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("psi", "expected"), [(0.0, (-0.05, -0.02)), (np.pi, (0.05, 0.02)), (np.pi / 2, (-0.02, 0.05))]
)
def test_grade_slows_uphill_and_pulls_downhill(psi, expected):
    place = STILL._replace(psi=jnp.asarray(psi))
    change = gain(car_with(road_grade=(0.05, 0.02)), state(20.0), control(), place)
    np.testing.assert_allclose(change * [1, 20, 1], [G * expected[0], G * expected[1], 0], atol=1e-12)


def test_drive_loads_the_rear_axle():
    model, nominal = car_with(load_transfer_long=0.5), load_vehicle("sedan").build()
    flow = model.flow(state(), control(Fxr=5000.0), STILL, NONE)
    np.testing.assert_allclose(flow.Fzr - nominal.Fzr, 0.5 * 5000 / 3.05)
    np.testing.assert_allclose(flow.Fzf + flow.Fzr, 1835 * G)


@pytest.mark.parametrize(("h", "seen"), [(0.0, 0.305), (0.5, 0.5)])
def test_load_sensitivity_takes_the_height_of_the_load_transfer_or_a_least_one(h, seen):
    model = car_with(load_transfer_long=h, load_sensitivity=0.2)
    flow = model.flow(state(), control(Fxr=5000.0), STILL, NONE)
    moved = seen * 5000 / 3.05
    np.testing.assert_allclose(flow.muf, 1 + 0.2 * moved / (1835 * G * 1.65 / 3.05))
    np.testing.assert_allclose(flow.mur, 1 - 0.2 * moved / (1835 * G * 1.4 / 3.05))


def test_downforce_loads_both_axles_as_the_weight_does():
    flow = car_with(downforce=0.6).flow(state(30.0), control(), STILL, NONE)
    np.testing.assert_allclose([flow.Fzf, flow.Fzr], (1835 * G + 0.6 * 900) * np.array([1.65, 1.4]) / 3.05)


@pytest.mark.parametrize("delta", [-0.4, 0.3])
def test_the_outer_front_wheel_turns_a_steered_car(delta, height=0.25, track=1.5):
    """As the forces of two front wheels do, whose loads differ by what a roll moment m a_y h_f moves."""
    x, u = state(beta=-0.3, r=0.7), control(delta=delta)
    model = car_with(load_transfer_lat=[0.0, 0.0, height])
    flow = model.flow(x, u, STILL, NONE)
    moved = flow.car.m * flow.ay * height / track  # onto the right wheel, where ay points to the left
    right = np.array([0.5 - moved / flow.Fzf, 0.5 + moved / flow.Fzf]) * flow.Fyf
    moment = -(track / 2 * np.array([1.0, -1.0])) @ (-right * np.sin(delta))
    rise = gain(model, x, u)
    np.testing.assert_allclose(rise[:2], 0.0, atol=1e-12)
    assert rise[2] * flow.car.Iz == pytest.approx(float(moment), rel=1e-9) and abs(moment) > 100


def test_roll_that_is_behind_takes_less_grip():
    model, x, u = car_with(roll_lag=0.1), state(10.0, -0.3, 0.7), control(0.1, 3000.0)
    assert float(model.car.roll_lag) == pytest.approx(0.1)
    at_once = model.flow(x, u, STILL, NONE)
    behind = model.flow(x, u, STILL, Aux(jnp.zeros(2), -at_once.ay))
    np.testing.assert_allclose(behind.mur, 1 + ROLL_GRIP * (at_once.ay / G) ** 2)
    assert abs(float(behind.Fyr)) > abs(float(at_once.Fyr))


def test_head_wind_of_the_cars_own_speed_quadruples_the_pressure():
    place = STILL._replace(psi=jnp.asarray(0.7))
    wind = (-12 * np.cos(0.7), -12 * np.sin(0.7))
    change = gain(car_with(side_wind=wind), state(12.0), control(), place)
    np.testing.assert_allclose(change, [-0.002 / 3.05 * 3 * 144, 0, 0], atol=1e-6)


def test_windows_of_the_patches_add_up_to_one():
    x, u = state(10.0, -0.3, 0.7), control(0.1, 3000.0)
    for s in np.linspace(0, 1, 9):
        place = STILL._replace(s=jnp.asarray(s))
        patched = car_with(friction_patch=np.full(6, 0.1)).rates(x, u, place, NONE)
        np.testing.assert_allclose(patched, car_with(friction=0.1).rates(x, u, place, NONE), rtol=1e-12)


@pytest.mark.parametrize("c", [2.8e-6, 1.1e-5])
def test_compliant_steering_is_in_balance_with_its_side_force(c):
    model, nominal = car_with(steer_compliance=c), load_vehicle("sedan").build()
    for x, u in ((state(15.0, 0.0, 0.3), control(0.05)), (state(10.0, -0.5, 0.8), control(-0.3, 4000.0))):
        flow = model.flow(x, u, STILL, NONE)
        np.testing.assert_allclose(flow.u.delta, u.delta - c * flow.Fyf, atol=2e-5)
        np.testing.assert_allclose(flow.alpha_f, nominal.slip_angles(x, flow.u)[0], atol=1e-12)


def test_front_share_of_the_drive_leaves_its_sum():
    np.testing.assert_allclose(gain(car_with(drive_split=0.4), state(), control(Fxr=3000.0)), 0, atol=1e-12)
    turned = gain(car_with(drive_split=0.4), state(), control(0.2, 3000.0))
    assert turned[0] == pytest.approx(0.4 * 3000 * (np.cos(0.2) - 1) / 1835)
    assert turned[2] == pytest.approx(1.4 * 0.4 * 3000 * np.sin(0.2) / 3234)


@pytest.mark.parametrize("name", ["drive_split", "brake_split"])
def test_the_whole_force_may_be_on_the_front_axle_but_only_of_its_own_sign(name):
    """At the upper bound a front-driven car, or one that brakes with its front axle only."""
    (p,) = EFFECTS[name].parameters
    upper = p.bounds(load_vehicle("sedan"))[1]
    assert upper == pytest.approx(1.0)
    for F in (3000.0, -3000.0):
        flow = car_with("sedan", **{name: upper}).flow(state(), control(0.2, F), STILL, NONE)
        front = F if (F > 0) == (name == "drive_split") else 0.0
        np.testing.assert_allclose([flow.Fxf, flow.Fxr], [front, F - front], atol=1e-9)


@pytest.mark.parametrize("side", [1, -1])
def test_an_axle_passes_on_no_more_than_its_friction(side):
    """Drive and brake, each axle: a small force passes on whole, and however much is asked for, it is never more."""
    limited, free = (car_with(traction_limit=p, drive_split=0.5, brake_split=0.5) for p in (1.0, 0.0))
    for F in (3000.0, 9000.0, 1e8):
        x, u = state(10.0, 0.05, 0.2), control(0.05, side * F)
        flow, plain = limited.flow(x, u, STILL, NONE), free.flow(x, u, STILL, NONE)
        held, plain_force = (np.array([flow.Fxf, flow.Fxr]) for flow in (flow, plain))
        grip = np.array([flow.muf * flow.Fzf, flow.mur * flow.Fzr])
        assert np.all(held * side > 0) and np.all(np.abs(held) < np.minimum(np.abs(plain_force), grip))
        share = np.abs(plain_force) / grip
        assert np.all(np.abs(held / plain_force - 1)[share < 0.25] < 1e-3)
        assert np.all(np.abs(np.abs(held) / grip - 1)[share > 100] < 1e-6)


def test_power_nears_its_limit():
    inputs = acted(car_with(power_limit=1 / 50e3), [(0.0, 5000.0), (0.0, 1e9), (0.0, -5000.0)])
    np.testing.assert_allclose(inputs[:, 1], [5000 / 2.4 ** (1 / 8), 5000, -5000], rtol=1e-4)
    forces = np.linspace(0.0, 20000.0, 41)
    inputs = acted(car_with(power_limit=1 / 50e3), [(0.0, force) for force in forces])
    sharp = np.minimum(forces, 5000.0)
    assert np.all(inputs[:, 1] <= sharp) and np.all(inputs[:, 1] >= 0.89 * sharp)
    assert np.all(np.diff(inputs[:, 1]) > 0)


def test_wheels_spin_up_with_a_lag_that_grows_with_speed():
    commands = [(0.0, 1000.0)] * 5
    spun, lagged = car_with(wheel_spin=0.004), car_with(drive_lag=0.08)
    np.testing.assert_allclose(acted(spun, commands, V=20.0), acted(lagged, commands, V=5.0), rtol=1e-12)
    assert acted(spun, commands, V=5.0)[0, 1] > acted(spun, commands, V=20.0)[0, 1]


def test_delay_of_two_steps_and_of_half_a_step():
    delta = np.array([0.1, 0.3, -0.2, 0.4, 0.0])
    commands = [(d, 0.0) for d in delta]
    np.testing.assert_allclose(acted(car_with(steer_delay=2 * DT), commands)[:, 0], [0, 0, 0.1, 0.3, -0.2], atol=1e-12)
    half = (delta + np.array([0, *delta[:-1]])) / 2
    np.testing.assert_allclose(acted(car_with(steer_delay=DT / 2), commands)[:, 0], half, atol=1e-12)


def test_play_holds_the_wheels_until_it_is_used_up():
    commands = [(d, 0.0) for d in (0.1, 0.2, 0.19, 0.15, -0.1, -0.09)]
    inputs = acted(car_with(steer_backlash=0.03), commands)[:, 0]
    np.testing.assert_allclose(inputs, [0.07, 0.17, 0.17, 0.17, -0.07, -0.07], atol=1e-12)


def test_sensors():
    x, dx = state(10.0, -0.3, 0.7), state(1.0, 0.5, -2.0)
    np.testing.assert_allclose(car_with(gyro_bias=0.02).sense(x, dx), [10, -0.3, 0.72])
    np.testing.assert_allclose(car_with(channel_delay=(0.1, 0.2, 0.3)).sense(x, dx), [9.9, -0.4, 1.3])
    vx, vy = 10 * np.cos(-0.3) - 0.2 * 0.7, 10 * np.sin(-0.3) + 0.5 * 0.7
    expected = [np.hypot(vx, vy), np.arctan2(vy, vx), 0.7]
    np.testing.assert_allclose(car_with(imu_lever_arm=(0.5, 0.2)).sense(x, dx), expected, rtol=1e-7)
