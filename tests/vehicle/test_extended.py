"""The extended car: the universal car's rates, files that go round, and mistakes reported in one sentence."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from driftjax.core import BadInput, Control, State
from driftjax.vehicle import (
    Extended,
    SingleTrack,
    actuator_lags,
    build_car,
    load_vehicle,
    unmodelled_effects,
    write_vehicle,
)
from driftjax.vehicle.effect import EFFECTS, Place, reference
from driftjax.vehicle.effect.flow import Aux
from driftjax.vehicle.extended import exclusion_reason
from driftjax.vehicle.parameters import EffectParameterValue, VehicleConfig
from driftjax.vehicle.universal import universal_car

STILL = Place(*map(jnp.asarray, (0.0, 0.0, 0.0, 0.0)))
NONE = Aux(jnp.zeros(2), jnp.zeros(()))
INSIDE = [name for name, effect in EFFECTS.items() if not exclusion_reason(effect)]
NUM = 16


def with_effects(car="sedan", size=1.0, combined_slip=1.0, names=(), **values) -> VehicleConfig:
    """A car with all parameters of `names` at `size` typical sizes, and with `values` of one-parameter effects, SI."""
    vehicle = dataclasses.replace(load_vehicle(car), combined_slip=combined_slip)
    effect_values = [
        EffectParameterValue(effect.name, p.name, values[name] if name in values else size * p.scale(vehicle))
        for name, effect in EFFECTS.items() if name in names or name in values for p in effect.parameters
    ]  # fmt: skip
    return dataclasses.replace(vehicle, effects=tuple(effect_values))


@functools.cache
def batch(car):
    """Rich states and commands (NUM,): grip and slides, both turns, drive and braking."""
    vehicle, rng = load_vehicle(car), np.random.default_rng(3)
    between = lambda low, high: jnp.asarray(rng.uniform(low, high, NUM))
    speed, rate, force = (reference(vehicle, of) for of in ("speed", "yaw_rate", "force"))
    x = State(speed * between(0.5, 3), between(-0.6, 0.6), rate * between(-0.6, 0.6))
    return x, Control(between(-0.4, 0.4), force * between(-0.2, 0.3))


@eqx.filter_jit
def rates_of(car, x, u):
    return jnp.stack(jax.vmap(car)(x, u), axis=1)


@eqx.filter_jit
def rates_of_all(model, thetas, x, u):
    """Rates (K, NUM, 3) of the car with the whole catalogue at each row of `thetas`, its actuators at rest."""

    def one(theta, x, u):
        at = model.with_parameters(theta)
        return jnp.stack(at.rates(x, at.apply_actuators(at.start(0.01), u, x.V, 0.01)[1], STILL, NONE))

    return jax.vmap(lambda theta: jax.vmap(lambda x, u: one(theta, x, u))(x, u))(thetas)


@pytest.mark.parametrize("car", ["sedan", "rc"])
def test_rates_are_the_universal_cars(car):
    vehicle, (x, u) = with_effects(car, size=0.7, names=INSIDE), batch(car)
    extended, model = build_car(vehicle), universal_car(vehicle, tuple(EFFECTS.values()))
    assert isinstance(extended, Extended) and list(extended.names) == INSIDE
    names = [effect.name for effect in EFFECTS.values() for _ in effect.parameters]
    theta = jnp.asarray([0.7 if name in INSIDE else 0.0 for name in names])
    every = rates_of_all(model, theta[None], x, u)[0]
    size = np.abs(np.asarray(every)).max(axis=0)
    np.testing.assert_allclose(rates_of(extended, x, u) / size, every / size, atol=1e-12)
    np.testing.assert_allclose(rates_of(extended.scaled(jnp.asarray(0.0)), x, u), rates_of(vehicle.build(), x, u),
                               rtol=1e-9, atol=1e-12)  # fmt: skip


def test_every_effect_of_the_catalogue_is_in_the_car_or_does_nothing_to_it_in_steady_use():
    vehicle, (x, u) = with_effects(), batch("sedan")
    model, nominal = universal_car(vehicle, tuple(EFFECTS.values())), rates_of(vehicle.build(), x, u)
    names = np.array([effect.name for effect in EFFECTS.values() for _ in effect.parameters])
    changed = np.abs(rates_of_all(model, jnp.eye(len(names)), x, u) - nominal).max(axis=(1, 2)) > 1e-9
    of_the_place = {"road_bank", "road_grade", "side_wind", "friction_patch"}
    memory = {"drive_lag", "wheel_spin", "steer_lag", "steer_delay", "steer_backlash"}  # at rest these hold back all
    assert set(names[changed]) - of_the_place - memory == set(INSIDE)
    assert len(INSIDE) == 33 and "traction_limit" in INSIDE
    assert {"mass", "steer_gain", "power_limit", "steer_compliance"} <= set(INSIDE)


def test_without_effects_in_it_the_car_is_the_nominal_one():
    for vehicle in (load_vehicle("sedan"), with_effects(names=("gyro_bias", "steer_lag", "relaxation_length"))):
        assert isinstance(build_car(vehicle), SingleTrack)
        assert eqx.tree_equal(build_car(vehicle), vehicle.build())
    np.testing.assert_array_equal(actuator_lags(load_vehicle("sedan")), [0, 0])


def test_what_is_not_in_the_car_is_reported_and_lags_are_kept():
    vehicle = with_effects(names=("friction", "gyro_bias", "road_grade", "relaxation_length"), drive_lag=0.15)
    notes = unmodelled_effects(vehicle)
    assert [note.split()[0] for note in notes] == ["relaxation_length", "drive_lag", "road_grade", "gyro_bias"]
    for note, words in zip(notes, ("what went before", "lags", "road", "sensors"), strict=True):
        assert words in note and note.endswith(".")
    np.testing.assert_allclose(actuator_lags(vehicle), [0.0, 0.15])


def test_slip_angles_and_peaks_are_those_of_the_extended_car():
    vehicle, (x, u) = with_effects(steer_offset=0.02, stiffness_front=0.1), batch("sedan")
    car, nominal = build_car(vehicle), vehicle.build()
    front, rear = eqx.filter_jit(lambda car, x, u: jax.vmap(car.slip_angles)(x, u))(car, x, u)
    alpha_f, alpha_r = jax.vmap(nominal.slip_angles)(x, u)
    np.testing.assert_allclose(front, alpha_f - 0.02, atol=1e-12)
    np.testing.assert_allclose(rear, alpha_r, atol=1e-12)
    np.testing.assert_allclose(car.peaks, [nominal.tyre.alpha_peak / 1.1, nominal.tyre.alpha_peak], rtol=1e-12)


def test_an_extended_car_keeps_its_ellipse_unless_it_is_given_another():
    assert load_vehicle("sedan").with_combined_slip(None).combined_slip == 1.0
    vehicle = with_effects(combined_slip=0.4, friction=-0.05)
    assert (
        vehicle.with_combined_slip(None).combined_slip == 0.4 and vehicle.with_combined_slip(0.0).combined_slip == 0.0
    )


NOMINAL = {
    k: v for k, v in dataclasses.asdict(load_vehicle("sedan")).items() if k not in ("effects", "covariance", "noise")
}
FOUND = {
    "load_transfer_lat": {"k_f": {"value": 0.03, "ci95_half": 0.01}, "k_r": {"value": 0.05, "ci95_half": 0.02}},
    "load_transfer_long": {"h": {"value": 0.3, "ci95_half": 0.04}},
}
ORDER = ["load_transfer_long.h", "load_transfer_lat.k_f", "load_transfer_lat.k_r"]
MATRIX = [[4e-4, 1e-5, 0.0], [1e-5, 2.5e-5, -1e-6], [0.0, -1e-6, 1e-4]]


def written(tmp_path, **changes):
    content = {"nominal": NOMINAL, "effects": FOUND, "covariance": {"parameters": ORDER, "matrix": MATRIX}} | changes
    path = tmp_path / "extended.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def test_an_extended_car_is_read_in_the_catalogues_order(tmp_path):
    vehicle = load_vehicle(written(tmp_path))
    assert [one.name for one in vehicle.effects] == [*ORDER, "load_transfer_lat.h_f"]  # files from before lack h_f
    assert [one.value for one in vehicle.effects] == [0.3, 0.03, 0.05, 0.0]
    assert [one.ci95_half for one in vehicle.effects] == [0.04, 0.01, 0.02, None]
    np.testing.assert_array_equal(vehicle.covariance, np.pad(MATRIX, (0, 1)))
    assert dataclasses.replace(vehicle, effects=(), covariance=()) == load_vehicle("sedan")
    car = build_car(vehicle)
    assert isinstance(car, Extended)
    np.testing.assert_allclose(car.theta * car.scale, [0.3, 0.03, 0.05, 0.0])


def test_noise_of_a_diagnosis_is_written_and_read(tmp_path):
    channels = {"V": 0.05, "beta": 0.01, "r": 0.02}
    noise = {"sigma": channels, "process_sigma": channels, "process_correlation_s": 0.3}
    older = load_vehicle(written(tmp_path, noise=noise)).noise
    slow = {"slow_sigma": channels, "slow_correlation_s": 0.5}
    vehicle = load_vehicle(written(tmp_path, noise=noise | slow))
    assert vehicle.noise is not None and dataclasses.asdict(vehicle.noise) == noise | slow
    none = {"slow_sigma": dict.fromkeys(channels, 0.0), "slow_correlation_s": 1.0}
    assert older is not None and dataclasses.asdict(older) == noise | none
    write_vehicle(tmp_path / "again.yaml", vehicle)
    assert load_vehicle(tmp_path / "again.yaml") == vehicle
    for wrong, message in (
        (
            noise | {"process_correlation_s": 0.0},
            "key 'noise': key 'process_correlation_s' is 0.0; it must be positive",
        ),
        (noise | {"slow_correlation_s": -1.0}, "'noise': key 'slow_correlation_s' is -1.0; it must be positive"),
        (noise | {"sigma": channels | {"r": -1.0}}, "'noise': key 'sigma': key 'r' is -1.0"),
        ({"sigma": channels}, "'noise': key 'process_sigma' is missing"),
        (3.0, "'noise' is 3.0; it needs keys"),
    ):
        with pytest.raises(BadInput, match=message):
            load_vehicle(written(tmp_path, noise=wrong))


def test_effects_may_stand_as_plain_numbers_beside_the_parameters_of_the_car(tmp_path):
    path = tmp_path / "by_hand.yaml"
    path.write_text(yaml.safe_dump(NOMINAL | {"effects": {"friction": {"p": -0.05}}}))
    assert load_vehicle(path).effects == (EffectParameterValue("friction", "p", -0.05),)
    path.write_text(yaml.safe_dump({"nominal": NOMINAL, "effects": {}}))
    assert load_vehicle(path) == load_vehicle("sedan")


BAD = {
    "effect 'magic': no such effect": {"effects": {"magic": {"p": 1.0}}},
    "friction has no parameter 'mu'; it has p": {"effects": {"friction": {"mu": 0.1}}},
    "load_transfer_lat lacks 'k_r'": {"effects": {"load_transfer_lat": {"k_f": 0.01}}},
    "friction.p is 0.7; the value lies in -0.84..0.6": {"effects": {"friction": {"p": 0.7}}},
    "load_transfer_long.h is -0.1": {"effects": {"load_transfer_long": {"h": {"value": -0.1}}}},
    "friction.p is nan; it needs a number": {"effects": {"friction": {"p": float("nan")}}},
    "friction.p is 'much'": {"effects": {"friction": {"p": "much"}}},
    "friction.p holds mean": {"effects": {"friction": {"p": {"mean": 0.1}}}},
    "friction is 0.1; it needs keys": {"effects": {"friction": 0.1}},
    "unknown key 'nominl'": {"nominl": {}},
    "key 'nominal' is 3": {"nominal": 3},
    "key 'm' is missing": {"nominal": {"name": "x"}},
    "'parameters': [load_transfer_long.h,": {"covariance": {"parameters": ORDER[::-1], "matrix": MATRIX}},
    "needs 3 rows of 3 numbers": {"covariance": {"parameters": ORDER, "matrix": MATRIX[:2]}},
    "no covariance in row 1, column 2": {
        "covariance": {"parameters": ORDER, "matrix": [[4e-4, 1.0, 0.0], *MATRIX[1:]]}
    },
}


@pytest.mark.parametrize("words", BAD)
def test_mistakes_are_reported_with_file_and_key(words, tmp_path):
    with pytest.raises(BadInput) as caught:
        load_vehicle(written(tmp_path, **BAD[words]))
    message = str(caught.value)
    assert words in message and "extended.yaml" in message and message.endswith(".") and "\n" not in message
