"""Steady states of extended cars: zero rates, the right side of the nominal ones, gradients, and a map."""

import csv
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from driftjax.core import RESULTS, Control, State
from driftjax.equilibrium import Branch, SlipRadius, solve_nominal, solve_steady
from driftjax.equilibrium.map import MapConfig, write_map
from driftjax.vehicle import Extended, build_car, load_vehicle
from driftjax.vehicle.parameters import EffectParameterValue

EFFECTS = {"friction": "p", "load_transfer_long": "h", "aero_drag": "c", "mass": "p", "steer_offset": "p"}
FIXED = SlipRadius(-0.45, 15.0)
found_at = eqx.filter_jit(lambda car, fixed: solve_steady(car, fixed, branch=Branch.COUNTERSTEER))
steady = lambda car, fixed=FIXED: found_at(car, fixed)  # one program for all


def extended(**values: float) -> Extended:
    """The sedan with a friction circle and these effects, SI; always the same ones, so that one program serves all."""
    effects = tuple(EffectParameterValue(name, p, values.get(name, 0.0)) for name, p in EFFECTS.items())
    car = build_car(dataclasses.replace(load_vehicle("sedan"), combined_slip=1.0, effects=effects))
    assert isinstance(car, Extended)
    return car


@pytest.mark.parametrize(
    "values",
    [{"load_transfer_long": 0.5}, {"friction": -0.1, "steer_offset": 0.03}, {"mass": 0.1, "aero_drag": 1.5}],
)
def test_the_extended_car_stands_still_where_it_is_found(values):
    car = extended(**values)
    out = steady(car)
    assert out.result == RESULTS.successful and out.eta == 1 and out.kind == Branch.COUNTERSTEER
    rates = jnp.stack(car(out.x, out.u))
    assert jnp.max(jnp.abs(rates)) < 1e-7
    assert jnp.max(jnp.abs(jnp.stack(car.nominal(out.x, out.u)))) > 1e-2


def test_less_friction_drifts_slower_and_an_offset_is_steered_against():
    nominal = eqx.filter_jit(lambda c: solve_nominal(c, FIXED, branch=Branch.COUNTERSTEER))(
        dataclasses.replace(load_vehicle("sedan"), combined_slip=1.0).build()
    )
    slower = steady(extended(friction=-0.1))
    assert float(slower.x.V) == pytest.approx(float(nominal.x.V) * np.sqrt(0.9), rel=1e-3)
    turned = steady(extended(steer_offset=0.03))
    np.testing.assert_allclose([turned.u.delta, turned.u.Fxr], [nominal.u.delta - 0.03, nominal.u.Fxr], rtol=1e-6)


@pytest.mark.slow
def test_gradient_by_the_height_of_the_centre_of_mass_equals_central_differences():
    car, h = extended(load_transfer_long=0.3), 1e-4
    steer = lambda size: steady(car.with_parameters(car.theta * size)).u.delta
    one = jnp.asarray(1.0)
    difference = (steer(one + h) - steer(one - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(steer)(one), difference, rtol=1e-5)
    assert abs(difference) > 1e-3


def test_no_nominal_drift_is_not_a_success():
    out = steady(extended(friction=-0.1), SlipRadius(0.45, 15.0))
    assert out.result == RESULTS.no_root


@pytest.mark.slow
def test_the_map_of_an_extended_car_is_true(tmp_path):
    vehicle = dataclasses.asdict(load_vehicle("rc"))
    nominal = {key: vehicle[key] for key in vehicle if key not in ("effects", "covariance", "noise")}
    path = tmp_path / "car.yaml"
    path.write_text(yaml.safe_dump({"nominal": nominal, "effects": {"friction": {"p": -0.08}}}))
    numbers = write_map(MapConfig(vehicle=str(path), num_V=2, num_ratio=2, ratio_min=0.7, ratio_max=0.95), tmp_path)
    with (tmp_path / "equilibria.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == numbers["steady_states"] >= 4 and numbers["worst_residual"] < 1e-9
    car = build_car(load_vehicle(path))
    for row in rows:
        V, beta, r, delta, Fxr = (jnp.asarray(float(row[key])) for key in ("V", "beta", "r", "delta", "Fxr"))
        assert np.abs(np.array(car(State(V, beta, r), Control(delta, Fxr)))).max() < 1e-6
    # the nominal car drifts from a ratio of 0.97 on
    assert {"grip", "countersteer"} <= {row["branch"] for row in rows} and numbers["unconfirmed"] == 0
