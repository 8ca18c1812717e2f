"""Figures of synthetic laps in closed form; intervals and reductions of the mean."""

import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.table import ReferenceTable
from driftjax.core import Control
from driftjax.learning.metrics import difference, interval, lap_figures, reduction
from driftjax.sim import LapCode, Sensed, Trace

START, END, LOST = 10.0, 30.0, 8.0


def table() -> ReferenceTable:
    flat = jnp.full(5, 9.0)
    return ReferenceTable(0.0, 10.0, *([flat] * 9), drift_start=START, drift_end=END)


def lap(s, e, beta, r, V, alive) -> Trace:
    s, e, beta, r, V = (jnp.broadcast_to(jnp.asarray(a, float), jnp.shape(s)) for a in (s, e, beta, r, V))
    zero = jnp.zeros_like(s)
    sensed = Sensed(V, beta, r, zero, zero, zero, s, e, zero)
    return Trace(jnp.asarray(alive), sensed, V, beta, r, zero, zero, zero, s, e, zero, zero, Control(zero, zero), zero)


S = np.arange(0.0, 40.5, 0.5)


def figures(trace: Trace, code: LapCode):
    return lap_figures(trace, jnp.asarray(int(code)), table(), jnp.full(trace.s.shape, 9.0), jnp.asarray(LOST))


def test_means_over_the_drift_section_of_a_completed_lap():
    e = np.where(S < 20, 0.4, -1.2)
    e = np.where((S < START) | (S > END), 99.0, e)  # outside the section nothing counts
    beta = np.where(S < 20, -0.5, -0.1)
    result = figures(lap(S, e, beta, 1.0, 9.5, np.ones_like(S, bool)), LapCode.COMPLETED)
    rows = np.abs(e[(S >= START) & (S <= END)])
    assert float(result.lateral_error) == pytest.approx(rows.mean())
    assert float(result.lateral_error_max) == pytest.approx(1.2)
    assert float(result.velocity_rmse) == pytest.approx(0.5)
    assert float(result.drift_share) == pytest.approx(20 / 41)
    assert bool(result.completed)


def test_means_are_over_distance_not_over_time():
    s = np.concatenate([np.arange(10, 20, 0.1), np.arange(20, 31, 1.0)])  # ten times as many rows in the first half
    e = np.where(s < 20 - 1e-9, 1.0, 3.0)
    result = figures(lap(s, e, -0.5, 1.0, 9.0, np.ones_like(s, bool)), LapCode.COMPLETED)
    assert float(result.lateral_error) == pytest.approx(2.0, abs=0.06)  # the last row adds nothing


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_only_sideslip_against_the_turn_counts_as_drift(turn):
    alive = np.ones_like(S, bool)
    assert float(figures(lap(S, 0.0, -0.5 * turn, turn, 9.0, alive), LapCode.COMPLETED).drift_share) == 1.0
    assert float(figures(lap(S, 0.0, +0.5 * turn, turn, 9.0, alive), LapCode.COMPLETED).drift_share) == 0.0
    assert float(figures(lap(S, 0.0, -0.3 * turn, turn, 9.0, alive), LapCode.COMPLETED).drift_share) == 0.0


def test_what_a_failed_lap_did_not_drive_counts_as_lost():
    alive = S <= 15.0
    held = np.minimum(S, 15.0)  # rows after the end repeat the last
    result = figures(lap(held, 0.5, -0.5, 1.0, 9.0, alive), LapCode.SPUN)
    driven, missing = 5.0, 15.0
    assert float(result.lateral_error) == pytest.approx((0.5 * driven + LOST * missing) / 20.0, rel=1e-6)
    assert float(result.lateral_error_max) == LOST
    assert float(result.drift_share) == pytest.approx(driven / 20.0)
    assert not bool(result.completed)


def test_a_lap_lost_before_the_section_has_the_lost_error():
    result = figures(lap(np.minimum(S, 5.0), 0.1, 0.0, 0.0, 9.0, S <= 5.0), LapCode.OFF_TRACK)
    assert float(result.lateral_error) == pytest.approx(LOST) and float(result.drift_share) == 0.0


def test_a_lap_that_does_not_reach_the_section_has_no_speed_error_and_does_not_lower_the_mean():
    lost = figures(lap(np.minimum(S, 5.0), 0.1, 0.0, 0.0, 3.0, S <= 5.0), LapCode.OFF_TRACK)
    assert np.isnan(float(lost.velocity_rmse))
    good = figures(lap(S, 0.1, -0.5, 1.0, 9.5, np.ones_like(S, bool)), LapCode.COMPLETED)
    statistics = interval(np.array([float(good.velocity_rmse), float(lost.velocity_rmse)]))
    assert statistics == {"mean": pytest.approx(0.5), "ci95": [None, None], "plants": 1, "all_plants": 2}
    assert interval(np.array([np.nan, np.nan])) == {"mean": None, "ci95": [None, None], "plants": 0, "all_plants": 2}
    gain = reduction(np.array([0.8, 0.6, np.nan]), np.array([0.4, np.nan, 0.1]))
    assert gain == {"value": pytest.approx(50.0), "ci95": [None, None], "plants": 1, "all_plants": 3}


def test_the_measured_error_is_of_measured_values_and_noise_drives_no_distance():
    rng = np.random.default_rng(0)
    e, s = 0.3 + 0.02 * rng.normal(size=len(S)), S + 0.4 * rng.normal(size=len(S))
    trace = lap(S, 0.1, -0.5, 1.0, 9.0, np.ones_like(S, bool))
    trace = trace._replace(sensed=trace.sensed._replace(s=jnp.asarray(s), e=jnp.asarray(e)))
    result = figures(trace, LapCode.COMPLETED)
    assert float(result.lateral_error) == pytest.approx(0.1)
    assert float(result.lateral_error_measured) == pytest.approx(0.3, abs=0.01)
    alive = S <= 15.0  # of a failed lap the way that it did not get counts once, whatever the noise adds up to
    half = figures(trace._replace(alive=jnp.asarray(alive)), LapCode.SPUN)
    assert float(half.lateral_error_measured) == pytest.approx((0.3 * 5 + LOST * 15) / 20, abs=0.3)


def test_the_interval_holds_the_mean_and_narrows_with_more_plants():
    values = np.random.default_rng(0).normal(2.0, 0.5, 400)
    few, many = interval(values[:25]), interval(values)
    for statistics, used in ((few, values[:25]), (many, values)):
        low, high = statistics["ci95"]
        assert statistics["mean"] == pytest.approx(used.mean()) and low < used.mean() < high
        assert high - low == pytest.approx(2 * 1.96 * used.std() / np.sqrt(len(used)), rel=0.15)
    assert interval(np.array([3.0])) == {"mean": 3.0, "ci95": [None, None], "plants": 1, "all_plants": 1}
    assert interval(np.full(5, 3.0))["ci95"] == [3.0, 3.0]


def test_two_plants_have_no_interval_and_three_have():
    """Over two Student's t has one degree of freedom: 0.1 and 0.3 m would be 0.2 [-1.1, 1.5] m, a negative error."""
    two, three = np.array([0.1, 0.3]), np.array([0.1, 0.3, 0.2])
    assert interval(two) == {"mean": pytest.approx(0.2), "ci95": [None, None], "plants": 2, "all_plants": 2}
    assert reduction(two, two / 2) == {"value": 50.0, "ci95": [None, None], "plants": 2, "all_plants": 2}
    assert difference(two, two + 1)["ci95"] == [None, None]
    assert interval(np.append(two, np.nan))["ci95"] == [None, None], "of three plants two have a value"
    low, high = interval(three)["ci95"]
    assert low < 0.2 < high and reduction(three, three / 2)["ci95"] == [pytest.approx(50.0)] * 2


def covered(ci95: list, truth: float) -> bool:
    return ci95[0] <= truth <= ci95[1]


@pytest.mark.parametrize("num", [3, 4, 8, 16])
def test_nominal_95_percent_of_intervals_hold_the_truth(num):
    """Nine in ten at the least, of few plants too: of means of normal and lognormal values, and of reductions of
    lognormal ones, paired with a correlation of 0.7 and spread as wide as by a factor e either way."""
    rng, draws = np.random.default_rng(0), 1500
    normal = [interval(values)["ci95"] for values in rng.normal(2.0, 0.5, (draws, num))]
    lognormal = [interval(values)["ci95"] for values in rng.lognormal(0.0, 0.5, (draws, num))]
    assert np.mean([covered(one, 2.0) for one in normal]) > 0.93
    assert np.mean([covered(one, np.exp(0.5**2 / 2)) for one in lognormal]) > 0.90
    for spread in (0.5, 1.0):
        first, other = rng.normal(size=(2, draws, num))
        before, after = np.exp(spread * first), 0.5 * np.exp(spread * (0.7 * first + 0.51**0.5 * other))
        intervals = [reduction(b, a)["ci95"] for b, a in zip(before, after, strict=True)]
        assert np.mean([covered(one, 50.0) for one in intervals]) > 0.90


def test_the_reduction_is_that_of_the_means_and_paired():
    before = np.array([1.0, 2.0, 4.0, 5.0])
    statistics = reduction(before, 0.6 * before)
    assert statistics["value"] == pytest.approx(40.0)
    np.testing.assert_allclose(statistics["ci95"], [40.0, 40.0])  # the same share in every plant: nothing left to vary
    mixed = reduction(before, np.array([0.5, 2.2, 3.0, 2.0]))
    assert mixed["value"] == pytest.approx(100 * (1 - 7.7 / 12.0)) and mixed["ci95"][0] < mixed["value"]
    assert mixed["ci95"][1] > mixed["value"]
    one = reduction(np.array([2.0]), np.array([1.0]))
    assert one == {"value": 50.0, "ci95": [None, None], "plants": 1, "all_plants": 1}
    assert reduction(before, np.array([0.0, 0.0, 0.0, 1.0]))["ci95"] == [None, None]  # no ratio without the last
    assert reduction(before, 2 * before)["value"] == pytest.approx(-100.0)


def test_a_lap_that_ends_in_numbers_that_are_not_counts_up_to_there():
    s = np.where(S <= 20, S, np.nan)
    result = figures(lap(s, 1.0, -0.5, 1.0, 9.0, S <= 20), LapCode.NON_FINITE)
    assert float(result.lateral_error) == pytest.approx((1.0 * 10 + LOST * 10) / 20)
    assert all(np.isfinite(value) for value in result)


def test_paired_differences_have_the_interval_of_student():
    before, apart = np.array([5.0, 9.0, 2.0, 7.0]), np.array([-1.0, -2.0, -1.5, -0.5])
    statistics = difference(before, before + apart)
    half = 3.18245 * apart.std(ddof=1) / 2  # the 97.5 % quantile of Student's t with three degrees of freedom
    assert statistics["mean"] == pytest.approx(-1.25) and statistics["pairs"] == 4
    np.testing.assert_allclose(statistics["ci95"], [-1.25 - half, -1.25 + half], rtol=1e-5)
    assert difference(before[:1], before[:1] + 1) == {"mean": 1.0, "ci95": [None, None], "pairs": 1}
    assert difference(before[:0], before[:0]) == {"mean": None, "ci95": [None, None], "pairs": 0}
