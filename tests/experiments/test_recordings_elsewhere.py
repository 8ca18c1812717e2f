"""Experiments on recordings that others published: what is read from their files, and the table of results."""

import numpy as np
import pytest

import driftjax as dj
from experiments import friction_maps, paired_runs


def test_a_run_without_names_and_times_is_read_by_its_path(tmp_path):
    """A circle of 5 m radius to the left at 1 m/s, sampled every 0.13 s; full steering is 1."""
    angle = 0.13 / 5 * np.arange(400)
    columns = [5 * np.sin(angle), 5 * (1 - np.cos(angle)), (angle + np.pi) % (2 * np.pi) - np.pi, 1 + 0 * angle]
    (tmp_path / "pid_1.csv").write_text(
        "\n".join(",".join(map(str, (*row, 0, 0, 0, 0, 0.25))) for row in zip(*columns, strict=True))
    )
    run = paired_runs.read_run(tmp_path / "pid_1.csv")
    assert run.dt == 0.1 and run.t[-1] == pytest.approx(0.13 * 399, abs=0.11)
    np.testing.assert_allclose(run.V, 1)
    np.testing.assert_allclose(run.r, 0.2, rtol=1e-3)
    np.testing.assert_allclose(run.delta, 0.25 * paired_runs.CAR.delta_max)
    geometric = np.tan(0.25 * paired_runs.CAR.delta_max) / (paired_runs.CAR.a + paired_runs.CAR.b)
    assert paired_runs.turning(run) == pytest.approx(0.2 / geometric, rel=1e-3)
    assert np.isnan(run.beta).all() and np.isnan(run.Fxr).all() and {"x", "y", "psi"} == set(run.extra)


def test_missing_copies_and_unknown_names_are_reported(tmp_path):
    with pytest.raises(dj.BadInput, match="give --data the folder of a copy"):
        paired_runs.main(paired_runs.Config(tmp_path, ("rd_path",), out=tmp_path / "out"))
    with pytest.raises(dj.BadInput, match="path 'road': choose from rd_path"):
        paired_runs.main(paired_runs.Config(tmp_path, ("road",)))
    with pytest.raises(dj.BadInput, match="recording 'DS9': choose from DS1"):
        friction_maps.main(friction_maps.Config(tmp_path, ("DS9",)))
    with pytest.raises(dj.BadInput, match="DS1: no such file"):
        friction_maps.main(friction_maps.Config(tmp_path, ("DS1",), out=tmp_path / "out"))


def test_the_table_says_whether_the_data_decided_the_friction():
    def parameter(value, **marks):
        return {"value": value, "ci95_half": 0.1, "dead": False, "flat": False, "at_bound": False} | marks

    one = {"parts": 3, "seconds": 20.4, "lost_s": 0.0, "lateral_acceleration": 7.25,
           "parameters": {"friction.p": parameter(-0.5), "steer_delay.d": parameter(0.08),
                          "steer_lag.tau": parameter(0.03)}}  # fmt: skip
    gentle = one | {"parameters": one["parameters"] | {"friction.p": parameter(0.0, flat=True)},
                    "verdict": "UNKNOWN", "named": []}  # fmt: skip
    refused = {key: one[key] for key in ("parts", "seconds", "lateral_acceleration")} | {"refused": "lost."}
    text = friction_maps.table({"DS2": gentle, "DS1": one, "DS3": refused})
    mu = dj.load_vehicle("f1tenth").mu
    first, second, third = text.splitlines()[2:]
    assert first == f"| DS1 | 3, 20 | 7.2 | {mu / 2:.2f} +- {0.1 * mu:.2f} | decided | 0.080, 0.030 | - |"
    assert second.endswith("| flat | 0.080, 0.030 | UNKNOWN: nothing |")
    assert third == "| DS3 | 3, 20 | 7.2 | lost. | - | - | - |"
