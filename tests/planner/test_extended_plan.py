"""Minimum-time plans of extended cars: feasible for the car itself, and later where it is weaker."""

import dataclasses
from functools import cache

import jax
import numpy as np
import pytest

from driftjax.core import RESULTS, Control, State
from driftjax.planner import Plan, PlanConfig, plan
from driftjax.track import load_track
from driftjax.vehicle import build_car, load_vehicle
from driftjax.vehicle.parameters import EffectParameterValue

CONFIG = PlanConfig(entry_speed=3.016, V_min=0.8, V_max=8.0, drift=False, num_nodes=121, front_slip=0.1)


def vehicle(**values):
    effects = tuple(EffectParameterValue(name, parameter, value) for name, (parameter, value) in values.items())
    return dataclasses.replace(load_vehicle("rc"), combined_slip=1.0, effects=effects)


@cache
def solved(friction: float) -> Plan:
    """The RC car's plan with this share of friction more; at 0 the car is the nominal one."""
    return plan(load_track("rc_corner"), vehicle(friction=("p", friction)), CONFIG)


@pytest.mark.slow  # compiles for a minute
def test_less_friction_takes_longer():
    times = []
    for friction in (-0.05, 0.0):
        solution = solved(friction)
        assert solution.result == RESULTS.successful and solution.violation < 1e-6
        times.append(float(solution.lap_time))
    assert times[0] > 1.003 * times[1]


@pytest.mark.slow
def test_the_plan_is_one_of_the_extended_car():
    """Its states move along the track as the extended car's rates say, and not as the nominal car's do."""
    solution = solved(-0.05)
    x, u = State(solution.V, solution.beta, solution.r), Control(solution.delta, solution.Fxr)
    own, nominal = (
        np.stack(jax.jit(jax.vmap(car))(x, u)) for car in (build_car(vehicle(friction=("p", -0.05))), vehicle().build())
    )
    moved = np.array([np.gradient(np.asarray(a), np.asarray(solution.t)) for a in x])
    inner, size = slice(3, -3), np.abs(moved).max(axis=1)
    error, other = (np.abs(np.asarray(a) - moved)[:, inner].mean(axis=1) / size for a in (own, nominal))
    assert np.all(error < 0.02) and np.any(other > 3 * error)


def test_an_ellipse_that_was_named_is_not_planned_over():
    options = dataclasses.replace(CONFIG, combined_slip=1.0)
    known = dataclasses.replace(vehicle(combined_slip=("p", 0.5)), combined_slip=0.0)
    assert options.planned(known).combined_slip == 0.0
    assert options.planned(dataclasses.replace(known, effects=())).combined_slip == 1.0
