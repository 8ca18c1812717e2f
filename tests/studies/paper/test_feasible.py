"""Which planned corners a learnt car can hold: the nominal car's where nothing was learnt, none beyond its grip."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import State
from driftjax.equilibrium import Branch, SlipRadius, solve_steady
from driftjax.learning.config import GPConfig
from driftjax.learning.model import empty
from driftjax.learning.scenario import repeated
from driftjax.parallel import call
from driftjax.studies.paper.feasible import drift_exists
from driftjax.vehicle import build_car, load_vehicle


@pytest.mark.slow
def test_a_car_that_learnt_nothing_holds_its_own_corner_and_no_faster_one():
    nominal = build_car(load_vehicle("sedan").with_combined_slip(1.0))
    beta, R = jnp.asarray(-0.45), jnp.asarray(12.0)
    steady = eqx.filter_jit(solve_steady)(nominal, SlipRadius(beta, R), branch=Branch.COUNTERSTEER)
    x: State = steady.x
    residual, branch = repeated(empty(GPConfig(size=20)).residual, 2), jnp.asarray(Branch.COUNTERSTEER)
    guess = (steady.x, steady.u)
    held_on = lambda *planned: call(drift_exists, residual, nominal, planned, guess, branch)
    # within its grip; at its very edge drifts meet and vanish
    exists, held, speed = held_on(0.97 * x.V, 0.97 * x.r, beta, R)
    assert np.all(held) and np.all(exists)
    np.testing.assert_allclose(speed, float(x.V), rtol=1e-6)
    exists, held, _ = held_on(1.2 * x.V, 1.2 * x.r, beta, R)
    assert np.all(held) and not np.any(exists)
