"""What the GP beside a named cause is taught: changes of the state that the model lacks, over the time they took."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diagnosis.recorded import sedan

from driftjax.core import State
from driftjax.diagnosis.fit import initial_problem
from driftjax.diagnosis.residual_gp import residual_rates
from driftjax.logs import Run
from driftjax.sim.rollout import SETTLE, actuator_response, begin, move, sensor_reading
from driftjax.vehicle.effect import effects_by_name
from driftjax.vehicle.effect.flow import Place
from driftjax.vehicle.universal import universal_car

EFFECTS = effects_by_name(("drive_gain", "speed_scale"))
NUM, DT = 250, 0.02
FIRST = 20  # samples after which the observer has forgotten where it began


def noise_free(theta, x0, delta, Fxr, dt: float, push=(0.0, 0.0, 0.0)) -> Run:
    """A run of the sedan with the effects `theta` from the state `x0`, `push` added to its rates; beta is wrapped."""
    lead, step = round(SETTLE / dt), jnp.asarray(dt)
    model = universal_car(sedan(), EFFECTS, substeps=10).with_parameters(jnp.asarray(theta))
    commands = np.pad(np.stack([delta, Fxr], axis=1), ((lead, 0), (0, 0)), mode="edge")
    u = actuator_response(model, jnp.asarray(commands), jnp.full(len(commands), 10.0), dt)
    place = Place(*(jnp.zeros(()),) * 4)

    def on(carry, u):
        z, rates = carry
        after = move(model, z, u, place, step, State(*map(jnp.asarray, push)))
        return (after.z, after.rates), sensor_reading(model, z[:3], rates, step)

    start = begin(model, jnp.asarray(x0), u[lead], place), jnp.zeros((3, 3))
    V, beta, r = np.asarray(jax.jit(lambda: jax.lax.scan(on, start, u[lead:])[1])()).T
    return Run("a", np.arange(NUM) * dt, V, np.angle(np.exp(1j * beta)), r, delta, Fxr, dt)


def lacking(run: Run, theta) -> np.ndarray:
    """Rates (n, 3) that the model `theta` lacks in `run`, where the observer has settled."""
    problem = initial_problem(sedan(), EFFECTS, (run,))
    _, rates, counted = residual_rates(problem, np.asarray(theta))
    return np.asarray(rates)[np.asarray(counted)][max(FIRST // round(0.2 / run.dt), 1) :]


def test_an_error_of_a_sensor_is_no_rate_that_the_car_lacks():
    t = np.arange(NUM) * DT
    theta = np.array([0.0, 0.05 / 0.03])  # the speed reads 5 % too high
    rates = lacking(noise_free(theta, [10.0, 0.0, 0.0], 0.05 * np.sin(3 * t), 0 * t, DT), theta)
    np.testing.assert_allclose(rates, 0.0, atol=0.01)


@pytest.mark.parametrize("rate", [12, *(pytest.param(rate, marks=pytest.mark.slow) for rate in (24, 100))])
def test_a_rate_is_the_change_over_the_time_that_it_took_at_any_sample_rate(rate):
    missing = 0.4  # [m/s^2]
    run = noise_free([0.0, 0.0], [8.0, 0.0, 0.0], np.zeros(NUM), np.zeros(NUM), 1 / rate, push=(missing, 0.0, 0.0))
    rates = lacking(run, [0.0, 0.0])
    np.testing.assert_allclose(rates[:, 0], missing, rtol=0.03)


def test_a_car_that_turns_round_lacks_no_turn():
    """Sideslip passes pi, where what is measured jumps by a turn."""
    run = noise_free([0.0, 0.0], [12.0, 2.6, -5.0], np.zeros(NUM), np.zeros(NUM), DT)
    assert np.abs(np.diff(run.beta)).max() > 6
    rates = lacking(run, [0.0, 0.0])
    assert np.median(np.abs(rates[:, 1])) < 0.1 and np.abs(rates[:, 1]).max() < 20.0
