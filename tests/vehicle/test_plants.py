"""Shipped plants, presets, distributions and batches."""

import dataclasses

import jax
import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.vehicle import draw_plants, load_plant, load_vehicle, stack_plants
from driftjax.vehicle.plants import Spread, load_distribution

CARS = ["sedan", "rc"]
PRESETS = {
    "sedan_mu10": ("sedan", 1.0, 1.0), "sedan_mu12": ("sedan", 1.2, 1.2), "sedan_front_bias": ("sedan", 1.15, 1.05),
    "rc_mu085": ("rc", 0.85, 0.85), "rc_mu110": ("rc", 1.1, 1.1),
}  # fmt: skip


@pytest.mark.parametrize("preset", PRESETS)
def test_preset_differs_from_its_base_in_friction_only(preset):
    base, muf, mur = PRESETS[preset]
    assert load_plant(preset) == dataclasses.replace(load_plant(base), name=preset, muf=muf, mur=mur)


@pytest.mark.parametrize("car", CARS)
def test_plant_agrees_with_the_nominal_car_where_that_speaks(car):
    plant, nominal = load_plant(car), load_vehicle(car)
    assert (plant.m, plant.Iz, plant.a, plant.b) == (nominal.m, nominal.Iz, nominal.a, nominal.b)
    np.testing.assert_allclose(plant.muf * plant.Bf * plant.C, nominal.mu * nominal.B * nominal.C, rtol=0.01)
    assert plant.delta_max >= nominal.delta_max and plant.Fxr_max >= nominal.Fxr_max
    assert plant.Fxr_min <= nominal.Fxr_min and plant.Fxr_rate_max >= nominal.Fxr_rate_max


@pytest.mark.parametrize("car", CARS)
def test_samples_lie_in_the_documented_ranges_and_fill_them(car):
    base, spreads = load_distribution(car)
    plants = draw_plants(car, 100, seed=3)
    for key, spread in spreads.items():
        if key.startswith("mu"):
            continue
        values = np.array([getattr(plant, key) for plant in plants])
        low, high = spread.limits
        assert low <= values.min() and values.max() <= high
        assert np.ptp(values) > 0.7 * (high - low)
    muf, mur = (np.array([getattr(plant, key) for plant in plants]) for key in ("muf", "mur"))
    assert np.all(np.abs((muf - mur) / (muf + mur) * 2) <= 0.05 + 1e-12)
    low, high = spreads["mu"].limits
    assert np.all(((muf + mur) / 2 >= low - 1e-12) & ((muf + mur) / 2 <= high + 1e-12))
    fixed = {field.name for field in dataclasses.fields(base)} - set(spreads) - {"name", "muf", "mur"}
    assert all(getattr(plant, key) == getattr(base, key) for plant in plants for key in fixed)


def test_plant_depends_on_seed_and_index_only():
    few, many = draw_plants("sedan", 3, seed=5), draw_plants("sedan", 6, seed=5)
    assert few == many[:3]
    assert draw_plants("sedan", 2, seed=5, first=4) == many[4:]
    assert len({plant.mur for plant in many + draw_plants("sedan", 6, seed=6)}) == 12


def test_normal_spread_has_the_moments_of_the_truncated_normal():
    generator = np.random.default_rng(0)
    draws = np.array([Spread(normal=(2.0, 0.1)).draw(generator) for _ in range(4000)])
    np.testing.assert_allclose(draws.mean(), 2.0, atol=4 * 0.1 / np.sqrt(4000))
    np.testing.assert_allclose(draws.std(), 0.088, rtol=0.05)  # truncation at two deviations leaves 0.880
    assert np.abs(draws - 2.0).max() <= 0.2


def test_spreads_that_make_no_sense_are_refused():
    for values in ({}, {"uniform": (1.0, 2.0), "normal": (1.0, 0.1)}, {"uniform": (2.0, 1.0)}):
        with pytest.raises(BadInput):
            Spread(**values)
    with pytest.raises(BadInput, match="at least one"):
        stack_plants([])
    with pytest.raises(BadInput, match="truck_distribution"):
        draw_plants("truck", 1, seed=0)


def test_base_that_leads_back_is_refused(tmp_path):
    for name, base in (("own", "own"), ("one", "two"), ("two", "one")):
        (tmp_path / f"{name}.yaml").write_text(f"base: {base}")
    for name in ("own", "one"):
        with pytest.raises(BadInput, match="'base'"):
            load_plant(tmp_path / f"{name}.yaml")


def test_stack_has_the_batch_axis_first_and_keeps_the_order():
    configs = draw_plants("rc", 3, seed=0)
    stack = stack_plants(configs)
    assert all(leaf.shape[0] == 3 for leaf in jax.tree.leaves(stack))
    np.testing.assert_allclose(stack.chassis.m, [config.m for config in configs])
    np.testing.assert_allclose(stack.tyre.mu[:, 2], [config.mur for config in configs])
