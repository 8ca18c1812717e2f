"""The curve of an axle's side force: what is computed from the fit, and the words for it."""

import jax.numpy as jnp
import numpy as np
import pytest
from diagnosis.recorded import sedan

from driftjax.diagnosis.curves import AxleCurve, _curve, describe_curve
from driftjax.parallel import call
from driftjax.vehicle.effect import effects_by_name
from driftjax.vehicle.universal import universal_car


def test_forces_are_those_of_friction_stiffness_and_form_together():
    model = universal_car(sedan(), effects_by_name(("friction_rear", "stiffness_rear", "tyre_curve_rear")))
    slip, p = np.linspace(0.0, 0.5, 9), np.array([0.3, -0.5, 0.8])
    thetas = np.stack([np.zeros(5), np.concatenate([[-0.1, 0.2], p]) / np.asarray(model.scale)])
    (nominal, _), (outputs, J) = (call(_curve, model, jnp.asarray(theta), jnp.asarray(slip), False) for theta in thetas)
    v = sedan()
    formula = v.mu * np.sin(v.C * np.arctan(v.B * slip))
    np.testing.assert_allclose(nominal[:-2], formula, atol=1e-12)
    bent = np.arctan(1.2 * v.B * slip)
    rates = lambda t: 1 + np.expm1(p) @ [6 * t**2 * (1 - t) ** 2, 4 * t**3 * (1 - t), t**4]
    angle = [v.C * np.pi / 2 * np.mean([rates(x) for x in (np.arange(2000) + 0.5) / 2000 * t]) * t
             for t in 2 / np.pi * bent]  # fmt: skip
    change = angle - v.C * bent
    change /= np.sqrt(1 + (change / (np.pi - v.C * bent)) ** 2)
    force = 0.9 * v.mu * np.sin(v.C * bent + change)
    np.testing.assert_allclose(outputs[:-2], force, atol=1e-6)
    np.testing.assert_allclose(outputs[-1], 1 - force[-1] / (0.9 * v.mu), atol=1e-6)
    small = 1e-5 * np.eye(5)
    moved = [call(_curve, model, jnp.asarray(thetas[1] + step), jnp.asarray(slip), False)[0] for step in small]
    np.testing.assert_allclose(J.T, (np.array(moved) - outputs) / 1e-5, atol=1e-3)


def test_the_words_say_peak_fall_and_range_or_that_there_is_no_fall():
    slip = np.radians([0.0, 8.0, 30.0])
    force = np.array([0.0, 1.0, 0.88])
    curve = AxleCurve("rear", slip, np.array([0.0, 1.0, 0.95]), force, np.stack([0.98 * force, 1.02 * force]),
                      slip[1], (np.radians(7.5), np.radians(8.5)), 0.12, (0.1, 0.14), 0.05)  # fmt: skip
    words = describe_curve(curve)
    assert "rear curve peaks at 8.0 deg [7.5, 8.5] and falls off 12 % [10, 14] after its peak up to 30 deg" in words
    assert words.endswith("the model's falls off 5 %.")
    rising = curve._replace(
        fitted=np.array([0.0, 0.8, 0.95]), peak=slip[2], drop=0.0, drop_ci95=(0.0, 0.0), nominal_drop=0.0
    )
    assert "does not fall off up to 30 deg" in describe_curve(rising) and "-20 % " in describe_curve(rising)
    assert curve.content()["slip"] == pytest.approx(slip.tolist())
