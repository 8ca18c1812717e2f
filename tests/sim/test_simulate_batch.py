"""Batches of open-loop simulations: equal to each alone, true to the equations, one failure does not spread."""

import dataclasses

import numpy as np
import pytest

import driftjax as dj

SEDAN = dj.load_vehicle("sedan")
COMMANDS = np.stack([np.full(40, 0.05), np.linspace(0, 3000, 40)], axis=1)
V, R = 9.0, 1.1  # where the sedan has a drift with countersteer [m/s], [rad/s]


@pytest.mark.parametrize("cars", [[SEDAN, dataclasses.replace(SEDAN, mu=0.6)], dj.draw_plants("sedan", 2, seed=1)])
def test_a_batch_of_cars_is_each_of_them_alone(cars):
    start = np.array([[12.0, 0.0, 0.0], [9.0, -0.1, 0.3]])
    batch = dj.simulate(cars, COMMANDS, 0.02, start=start)
    for i, car in enumerate(cars):
        alone = dj.simulate(car, COMMANDS, 0.02, start=start[i])
        for name in ("V", "beta", "r", "x", "psi", "ay"):
            np.testing.assert_allclose(batch[name][i], alone[name][0], rtol=1e-9, atol=1e-9)
    assert batch.V.attrs["units"] == "m/s" and batch.beta.dims == ("car", "time")
    np.testing.assert_allclose([batch.V[0, 0], batch.beta[1, 0], batch.r[1, 0]], [12.0, -0.1, 0.3])


def test_a_steady_drift_stays_where_it_is_for_as_long_as_rounding_lets_it():
    states = dj.equilibria(SEDAN, [V], [R]).isel(point=0)
    drift = states.isel(root=int((states.branch == dj.Branch.COUNTERSTEER).argmax("root")))
    command = np.tile([float(drift.delta), float(drift.Fxr)], (40, 1))
    data = dj.simulate(SEDAN, command, 0.01, start=[V, float(drift.beta), R])
    np.testing.assert_allclose(data.beta[0], float(drift.beta), atol=1e-6)
    np.testing.assert_allclose(data.r[0], R, atol=1e-6)
    np.testing.assert_allclose(data.psi[0, -1], R * 0.01 * 39, atol=1e-6)
    np.testing.assert_allclose(data.ay[0] / np.cos(data.beta[0]), V * R, rtol=0.05)  # mostly centripetal


def test_a_car_whose_numbers_overflow_leaves_the_others_alone():
    data = dj.simulate(SEDAN, COMMANDS, 0.02, start=[[12.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    alone = dj.simulate(SEDAN, COMMANDS, 0.02, start=[12.0, 0.0, 0.0])
    np.testing.assert_allclose(data.V[0], alone.V[0], rtol=1e-12)
    assert np.isnan(data.V[1]).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"commands": np.zeros((4, 3))}, "commands have shape"),
        ({"start": [1.0, 2.0]}, "start has shape"),
        ({"dt": 0.0}, "positive time"),
        ({"commands": np.zeros((3, 4, 2)), "start": np.ones((2, 3))}, "batches of"),
        ({"cars": [SEDAN, *dj.draw_plants("sedan", 1, seed=0)]}, "each kind by itself"),
    ],
)
def test_shapes_that_do_not_fit_are_refused_in_a_sentence(change, words):
    values = {"cars": SEDAN, "commands": COMMANDS, "dt": 0.02} | change
    with pytest.raises(dj.BadInput, match=words):
        dj.simulate(values.pop("cars"), values.pop("commands"), values.pop("dt"), **values)
