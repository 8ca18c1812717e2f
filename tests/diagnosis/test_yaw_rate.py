"""Logs without a yaw rate: it is the rate of the heading."""

import dataclasses

import numpy as np
import pytest

import driftjax as dj
from driftjax.diagnosis.resolve import resolved_log

DT = 0.02
T = DT * np.arange(500)
NONE = np.full_like(T, np.nan)


def turning(**extra) -> tuple[dj.Run, np.ndarray]:
    """Return a run without yaw rate, and the true one."""
    V, beta = 15 + 2 * np.sin(0.5 * T), 0.4 * np.sin(1.3 * T)
    return dj.Run("turning", T, V, beta, NONE, 0 * T, 0 * T, DT, extra), 0.8 * np.sin(2 * T)


def estimated(run: dj.Run) -> tuple[np.ndarray, tuple[str, ...]]:
    log = resolved_log(dj.load_vehicle("sedan"), dj.Log((run,)))
    return log.runs[0].r, log.notes


def test_the_rate_of_a_noisy_heading_has_no_bias():
    noise = 0.002 * np.random.default_rng(0).standard_normal(len(T))
    noise[100:110] = np.nan
    run, true = turning(psi=0.4 * (1 - np.cos(2 * T)) + noise)
    r, notes = estimated(run)
    there, known = np.isfinite(noise), np.isfinite(r)
    assert known[there].mean() > 0.99 and not known[102:108].any()
    assert np.std((r - true)[known]) < 1.5 * np.nanstd(np.gradient(noise, DT))
    silent, _ = estimated(turning(psi=0.4 * (1 - np.cos(2 * T)))[0])
    np.testing.assert_allclose(silent, true, atol=1e-4)
    assert any("rate of their heading" in note for note in notes)


def test_a_measured_yaw_rate_stays_and_a_run_with_nothing_is_refused():
    run, true = turning(psi=0.4 * (1 - np.cos(2 * T)))
    measured = dataclasses.replace(run, r=true)
    assert estimated(measured)[0] is measured.r and not estimated(measured)[1]
    with pytest.raises(dj.BadInput, match="Run 'turning' has neither a yaw rate nor a heading; map r or psi"):
        estimated(dataclasses.replace(run, extra={"psi": NONE}))
