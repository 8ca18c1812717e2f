"""Tyres that fall off beyond what the formula can do are named as a free form, and what the formula can do is not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diagnosis.recorded import DT, ROWS, build_problem, nominal_car, standard, truth

from driftjax.diagnosis.evidence import Cause, find_causes
from driftjax.diagnosis.naming import name_effects
from driftjax.diagnosis.verdict import describe_cause
from driftjax.logs import Run
from driftjax.manoeuvres.campaign import is_lost
from driftjax.manoeuvres.library import RICH
from driftjax.parallel import call
from driftjax.sim.record import Conditions, record
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import Effect, Parameter, effects_by_name
from driftjax.vehicle.effect.flow import Flow
from driftjax.vehicle.universal import Universal, universal_car

TYRES = effects_by_name(
    tuple(
        "friction_front friction_rear stiffness_front stiffness_rear tyre_shape sliding_friction combined_slip "
        "load_transfer_long steer_offset drive_gain tyre_curve_front tyre_curve_rear".split()
    )
)


def fall_off(flow: Flow, p) -> Flow:
    """Take the share p from the rear force, smoothly between one and three times the slip of the formula's peak."""
    u = jnp.clip((jnp.abs(flow.alpha_r) / flow.car.tyre_r.alpha_peak - 1) / 2, 0.0, 1.0)
    return flow._replace(Fyr=flow.Fyr * (1 - p[0] * u**2 * (3 - 2 * u)))


LATE = Effect("late", 99, "force", (Parameter("D", "1", 0.1),), fall_off, "", "the rear falls off late")


def drive(model: Universal, car: str, manoeuvre, conditions: Conditions, keys):
    vehicle = nominal_car(car)
    return jax.vmap(lambda one, key: record(model, vehicle, one, conditions, key, DT))(manoeuvre, keys)


def named(car: str, seed: int, hidden: dict[str, float]) -> tuple[dict[str, Cause], dict[str, str]]:
    """Causes named in six runs of a car with the effects `hidden`, in typical sizes, and their words."""
    model, t = universal_car(nominal_car(car), (*TYRES, LATE)), np.arange(ROWS) * DT
    owner = [effect.name for effect in model.effects for _ in effect.parameters]
    model = model.with_parameters(jnp.asarray([hidden.get(name, 0.0) for name in owner]))
    keys = jax.random.split(jax.random.key(seed), len(RICH))
    conditions = Conditions(*map(jnp.asarray, truth(car)))
    records = jax.tree.map(np.asarray, call(drive, model, car, standard(seed, car), conditions, keys))
    each = [jax.tree.map(lambda a: a[i], records) for i in range(len(RICH))]  # noqa: B023
    kept = [(name, one) for name, one in zip(RICH, each, strict=True) if not is_lost(nominal_car(car), one)]
    columns = lambda one: (*one.y.T, *one.command.T)
    rows = [(f"{name}{i}", *columns(one)) for i, (name, one) in enumerate(kept)]
    runs = [Run(name, t, V, beta, r, delta, Fxr, DT, {}) for name, V, beta, r, delta, Fxr in rows]
    problem, selection = name_effects(build_problem(nominal_car(car), TYRES, tuple(runs)), seed)
    causes = find_causes(problem, selection)
    name = lambda cause: problem.effects[cause.effect].name
    return {name(one): one for one in causes}, {name(one): describe_cause(problem, one) for one in causes}


@pytest.mark.slow
@pytest.mark.parametrize(("car", "also"), [("sedan", {}), ("rc", {}), ("sedan", {"friction_rear": -1.0})])
def test_a_rear_that_falls_off_late_is_named_and_its_fall_is_right(car, also):
    causes, words = named(car, 3, {"late": 1.2} | also)
    assert set(causes) == {"tyre_curve_rear", *also} and causes["tyre_curve_rear"].probability > 0.95, words
    curve, vehicle = causes["tyre_curve_rear"].curve, load_vehicle(car)
    assert curve is not None
    left = np.sin(vehicle.C * np.arctan(vehicle.B * curve.slip[-1]))  # beyond three times the peak's slip
    assert curve.slip[-1] > 3 * vehicle.build().tyre.alpha_peak
    assert curve.drop == pytest.approx(1 - 0.88 * left, abs=0.02)
    assert curve.drop_ci95[0] < 1 - 0.88 * left < curve.drop_ci95[1]
    assert "falls off" in words["tyre_curve_rear"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stiffness_rear", "friction_rear", "tyre_shape", "sliding_friction", "combined_slip"])
@pytest.mark.parametrize("car", ["sedan", "rc"])
def test_what_the_formula_can_do_is_named_as_before(car, name):
    causes, words = named(car, 5, {name: -1.0 if name == "friction_rear" else 1.0})
    assert set(causes) == {name}, words
