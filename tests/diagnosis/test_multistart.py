"""A strong effect in data without disturbances, which throws the observer of the nominal car off."""

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, ORDER, hidden, recorded, sedan

from driftjax.core import BadInput
from driftjax.diagnosis.fit import first_guess, observed, priced, problem
from driftjax.diagnosis.multistart import LOST, approach, misfit, nominal, round_about


def test_what_is_found_round_about_is_what_was_hidden():
    truth = hidden(friction_rear=1.4, load_transfer_long=1.4)
    task = problem(sedan(), EFFECTS, recorded(truth, 5, 6, disturbed=0.0))
    anew, found = round_about(task, 0)
    assert sorted(ORDER[i] for i in found.members) == ["friction_rear", "load_transfer_long"]
    np.testing.assert_allclose(found.fit.theta, truth, atol=0.05)
    assert misfit(anew, found.fit) < 1.1 and found.first.p_value < 0.05
    assert misfit(found.base, found.nominal) < 1.5  # that observer follows the car whatever acts on it
    assert anew.noise.disturbance.max() < 0.1 * found.base.noise.disturbance.max()


def test_a_lost_observer_is_no_end():
    """Gains that trust the nominal car entirely, and sensors twice as good as they are."""
    truth = hidden(friction_rear=1.4)
    task = problem(sedan(), EFFECTS, recorded(truth, 5, 7, disturbed=0.0))
    noise = first_guess(task.data)
    trusting = observed(task, 0 * truth, noise._replace(sigma=noise.sigma / 2, disturbance=1e-4 * noise.disturbance))
    assert misfit(trusting, nominal(trusting)) > LOST
    anew, found = approach(trusting)
    assert [ORDER[i] for i in found.members] == ["friction_rear"] and anew is not trusting
    assert found.fit.cost < priced(anew, truth).cost + 1.0


def test_data_that_no_car_can_have_made_are_refused():
    run = recorded(hidden(), 5, 8)[0]
    broken = (run.__class__(run.name, run.t, 1e200 * run.V, run.beta, run.r, run.delta, run.Fxr, run.dt, {}),)
    with pytest.raises(BadInput, match="units"):
        approach(problem(sedan(), EFFECTS, broken))
