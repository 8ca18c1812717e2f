"""Channels of a made-up drive that agree, and what a bias, a scale or a delay in one of them shows."""

import json
from dataclasses import replace

import numpy as np
import pytest

from driftjax.cli import main
from driftjax.logs import Log, Run, write_log
from driftjax.logs.agreement import Agreement, agreements, smooth_with_rate, time_shift
from driftjax.logs.inspection import inspect

DT, NUM, L = 0.01, 3000, 2.5


def drive(**changed: float) -> Run:
    """A car on a winding road; `changed` adds to a channel, `..._slope` scales it, `..._late` delays it [s]."""
    t = np.arange(NUM) * DT
    V, beta = 12 + 2 * np.sin(0.5 * t), 0.05 * np.sin(0.9 * t)
    r = 0.12 * np.sin(0.7 * t) + 0.1 * np.sin(2.3 * t)
    summed = lambda rate: (np.cumsum(rate) - rate / 2) * DT
    psi = summed(r)
    x, y = summed(V * np.cos(psi + beta)), summed(V * np.sin(psi + beta))
    dV, dbeta = np.gradient(V, DT), np.gradient(beta, DT)
    turn = V * (dbeta + r)
    ax, ay = dV * np.cos(beta) - turn * np.sin(beta), dV * np.sin(beta) + turn * np.cos(beta)
    made = {"V": V, "beta": beta, "r": r, "delta": np.arctan(r * L / V), "Fxr": 100 + 0 * t, "x": x, "y": y, "psi": psi,
            "ax": ax, "ay": ay}  # fmt: skip
    for name, values in made.items():
        late = np.interp(t - changed.get(f"{name}_late", 0.0), t, values)
        made[name] = changed.get(f"{name}_slope", 1.0) * late + changed.get(name, 0.0)
    extra = {name: made.pop(name) for name in ("x", "y", "psi", "ax", "ay")}
    return Run("road", t, **made, dt=DT, extra=extra)


def agreement_of(run: Run) -> dict[tuple[str, str], Agreement]:
    return {(one.channel, one.other.split()[0]): one for one in agreements([run], L)}


def test_channels_of_one_motion_agree():
    agreement = agreement_of(drive())
    assert len(agreement) == 6
    for name, one in agreement.items():
        assert one.slope == pytest.approx(1, abs=0.02), name
        assert abs(one.offset) < 0.01 and abs(one.shift) < 0.006 and one.correlation > 0.99, name
        assert one.shift_half_width < 0.01, name


def test_lateral_acceleration_is_checked_without_a_measured_sideslip():
    """By the sideslip of the pose, and by V r where there is none; an axis the other way shows."""
    run = replace(drive(ay_slope=-1.0), beta=np.full(NUM, np.nan))
    agreement = agreement_of(run)
    assert agreement["ay", "V'"].slope == pytest.approx(-1, abs=0.02) and ("beta", "course") not in agreement
    assert agreement["ax", "V'"].slope == pytest.approx(1, abs=0.05)
    bare = agreement_of(replace(run, extra={"ay": run.extra["ay"]}))
    assert bare["ay", "V"].slope == pytest.approx(-1, abs=0.1) and len(bare) == 2
    assert ("ay", "V") not in agreement


def test_wheels_tell_their_radius_and_by_how_much_the_speed_is_late():
    """As that of a satellite receiver; the car is 1.6 m wide between its wheels of 0.3 m."""
    run, late = drive(), drive(V_late=0.1)
    ahead, turned = run.V * np.cos(run.beta) / 0.3, run.r * 1.6 / 0.3 / 2
    wheels = {"wfl": ahead - turned, "wfr": ahead + turned, "wrl": ahead - turned, "wrr": ahead + turned}
    agreement = agreement_of(replace(late, extra=run.extra | wheels))
    for axle in ("front", "rear"):
        one = agreement["V", axle]
        assert one.slope == pytest.approx(0.3, rel=0.02) and one.shift == pytest.approx(0.1, abs=0.02)
    assert agreement["r", "rear"].slope == pytest.approx(0.3 / 1.6, rel=0.02)
    assert ("V", "front") not in agreement_of(run)


@pytest.mark.parametrize(
    ("changed", "where", "what", "size"),
    [
        ({"r": 0.02}, ("r", "rate"), "offset", 0.02),
        ({"beta": -0.01}, ("beta", "course"), "offset", -0.01),
        ({"V_slope": 1.05}, ("V", "speed"), "slope", 1.05),
        ({"ay": 0.6}, ("ay", "V'"), "offset", 0.6),
        ({"ax_slope": 1.1}, ("ax", "V'"), "slope", 1.1),
        ({"delta_slope": 1 / 1.2}, ("r", "V"), "slope", 1.2),
        ({"delta_late": -0.15}, ("r", "V"), "shift", 0.15),
        ({"r_late": 0.08}, ("r", "rate"), "shift", 0.08),
    ],
)
def test_a_fault_shows_as_what_it_is(changed, where, what, size):
    assert getattr(agreement_of(drive(**changed))[where], what) == pytest.approx(size, rel=0.05, abs=0.002)


def test_the_interval_of_a_delay_holds_it_and_is_wide_where_two_channels_share_but_a_trend():
    """Noise as large as a quarter of the motion; and ramps, which agree as well at any shift."""
    rng, t = np.random.default_rng(4), np.arange(NUM) * DT
    held = 0
    for _ in range(20):
        x = smooth_with_rate(rng.standard_normal(NUM), DT)[0]
        y = np.interp(t - 0.12, t, x) + 0.25 * np.nanstd(x) * smooth_with_rate(rng.standard_normal(NUM), DT)[0] / 0.2
        delay = time_shift([(y, x)], DT)
        held += abs(delay.value - 0.12) < delay.half_width < 0.05
    assert held >= 16
    ramp = lambda: t + 0.5 * smooth_with_rate(rng.standard_normal(NUM), DT)[0]
    assert time_shift([(ramp(), ramp())], DT).half_width > 0.3


def test_too_few_samples_have_no_delay_and_no_interval():
    x = np.sin(np.arange(150) * 0.2)
    assert np.isnan(time_shift([(x[:140], x[:140])], DT)).all()
    value, half = time_shift([(x, x)], DT)
    assert abs(value) < 1e-3 and np.isnan(half), "50 samples, and none without a part of them"


def test_a_log_too_short_for_an_interval_prints_none():
    run = drive()
    few = slice(0, 153)
    cut = {name: getattr(run, name)[few] for name in ("t", "V", "beta", "r", "delta", "Fxr")}
    short = Run("short", **cut, dt=DT, extra={name: values[few] for name, values in run.extra.items()})
    inspection = inspect(Log((short,)), L)
    assert any(np.isnan(one.shift_half_width) for one in inspection.agreement)
    assert "nan" not in str(inspection) and str(inspection).rstrip().endswith("ms")


def test_what_is_missing_or_too_short_is_not_compared():
    run = drive()
    del run.extra["x"]
    assert ("V", "speed") not in agreement_of(run) and ("r", "rate") in agreement_of(run)
    few = slice(0, 20)
    cut = {name: getattr(run, name)[few] for name in ("t", "V", "beta", "r", "delta", "Fxr")}
    short = Run("short", **cut, dt=DT)
    assert agreements([short], L) == []


def test_missing_values_leave_out_their_samples_only():
    run = drive(r=0.02)
    rng = np.random.default_rng(1)
    for channel, share in (
        (run.V, 0.1),
        (run.beta, 0.3),
        (run.r, 0.05),
        (run.extra["psi"], 0.1),
        (run.extra["x"], 0.2),
    ):
        channel[rng.random(NUM) < share] = np.nan
    run.beta[1000:1500] = np.nan  # a dropout
    run.extra["ay"][:] = np.nan  # never measured
    agreement = agreement_of(run)
    assert ("ay", "V'") not in agreement
    assert agreement["r", "rate"].offset == pytest.approx(0.02, abs=0.002)
    assert agreement["V", "speed"].slope == pytest.approx(1, abs=0.02)
    complete = agreement_of(drive(r=0.02))["beta", "course"].num
    assert 0.5 * complete < agreement["beta", "course"].num < complete - 450


def test_a_log_is_inspected(tmp_path, capsys):
    write_log(tmp_path / "log.csv", [drive(r=0.02)])
    out = tmp_path / "out"
    assert main(["inspect", str(tmp_path / "log.csv"), "--vehicle", "sedan", "--out", str(out)]) == 0
    output = capsys.readouterr().out
    assert "1 runs, 30.0 s at 100 Hz" in output and "rate of the heading" in output
    content = json.loads((out / "inspection.json").read_text())
    assert content["channels"]["r"]["unit"] == "rad/s" and len(content["agreement"]) == 6
    assert (out / "figures" / "channels.png").stat().st_size > 10000
    assert main(["inspect", str(tmp_path / "none.csv")]) == 2
    assert main(["inspect", str(tmp_path / "log.csv"), "--guess", "--write", str(tmp_path / "map.yaml")]) == 0
    assert "follows rate of the heading" in capsys.readouterr().out
    assert (
        main(["inspect", str(tmp_path / "log.csv"), "--columns", str(tmp_path / "map.yaml"), "--out", str(out / "2")])
        == 0
    )
    assert main(["inspect", str(tmp_path / "log.csv"), "--write", str(tmp_path / "other.yaml")]) == 2
    assert "flag '--write' writes what '--guess' proposes" in capsys.readouterr().err
