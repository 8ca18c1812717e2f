"""`driftjax compare`: a change named beside an error that both logs share, and one sentence for bad input."""

import json
import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS

import driftjax as dj
from driftjax.cli import main
from driftjax.diagnosis.compare import CompareConfig, Difference, gap_sentence, judge, range_sentence
from driftjax.diagnosis.gain import Errors, Share
from driftjax.diagnosis.gap import Gap, Overlap
from driftjax.logs import Run, write_log
from driftjax.vehicle.effect import EFFECTS as EFFECTS_BY_NAME

EXAMPLE = Path(__file__).parents[2] / "experiments" / "examples" / "compare.py"
TRUE = -1.0 * EFFECTS_BY_NAME["friction_rear"].parameters[0].typical


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Every test works in an empty folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """What the example leaves: less grip at the rear in B, and a gyro that is biased in both logs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", [str(EXAMPLE), str(tmp_path_factory.mktemp("compare"))])
        # the small catalogue, that other tests compile
        patch.setattr(dj.compare, "__kwdefaults__", {**(dj.compare.__kwdefaults__ or {}), "effects": EFFECTS})
        yield runpy.run_path(str(EXAMPLE), run_name="__main__")


def test_lower_friction_is_named_and_a_bias_that_both_logs_share_is_not(example):
    content = json.loads((Path(example["out"]) / "compare.json").read_text())
    assert (content["schema"], content["verdict"]) == (1, "NAMED")
    assert [one["effect"] for one in content["differences"]] == ["friction_rear"]
    assert "gyro_bias" in content["named"]["a"] and "gyro_bias" in content["named"]["b"]
    row = content["differences"][0]["parameters"]["p"]
    low, high = row["ci95"]
    assert low < TRUE < high < 0.5 * TRUE
    assert row["b"] - row["a"] == pytest.approx(row["difference"]) and 0 < row["a_error"] < -0.1 * TRUE
    gap = content["gap"]["b"]
    at = gap["horizons_s"].index(gap["decisive_horizon_s"])
    assert gap["ratio_ci95"]["other"]["all"][at][0] > 1.3 and gap["ratio_to_own"]["corrected"]["all"][at] < 1.1
    assert gap["closed"]["value"] > 0.8 and gap["held_out"]
    assert set(content["overlap"]) == {"V", "beta", "r", "delta", "Fxr"}


def test_the_verb_prints_and_draws_what_was_found(example, monkeypatch, capsys):
    monkeypatch.setattr("driftjax.cli.compare.compare", lambda *logs, **options: example["comparison"])
    for name, log in zip("ab", example["logs"], strict=True):
        write_log(Path(f"{name}.csv"), log.runs)
    assert main(["compare", "a.csv", "b.csv", "--out", "out"]) == 0
    output, page = capsys.readouterr().out, Path("out/report.html").read_text()
    assert example["comparison"].sentence in output and "car of A with the named differences" in output
    assert page.count("data:image/png;base64,") == 1 and "friction_rear.p" in page
    assert main(["report", "out"]) == 0


def runs(dt: float = 0.01, num: int = 200, name: str = "a", phase: float = 0.0) -> list[Run]:
    t = np.arange(num) * dt
    wave = 0.1 * np.sin(5 * t + phase)
    return [Run(name, t, 10 + wave, wave, wave, wave, 100 * wave, dt)]


def test_two_seconds_say_nothing(capsys):
    write_log(Path("a.csv"), runs())
    write_log(Path("b.csv"), runs(phase=1.0))
    assert main(["compare", "a.csv", "b.csv", "--out", "out"]) == 0
    content = json.loads(Path("out/compare.json").read_text())
    assert content["verdict"] == "DATA_INSUFFICIENT" and content["differences"] == [] and content["gap"] is None
    assert "Log A holds 2.0 s" in capsys.readouterr().out and "2.0 s" in Path("out/report.html").read_text()
    assert main(["runs"]) == 0


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["a.csv", "none.csv"], "none.csv"),
        (["a.csv", "slow.csv"], "Run 'A: a' has 100 Hz but run 'B: a' has 50 Hz"),
        (["a.csv", "fast.csv"], "Run 'A: a' has 100 Hz but run 'B: a' has 200 Hz"),  # though 200 Hz would be thinned
        (["a.csv", "a.csv"], "A and B hold the same runs"),
        (["a.csv", "copy.csv"], "A and B hold the same runs"),
        (["a.csv", "b.csv", "--runs-b", "lap*"], "no run is called lap*"),
        (["a.csv", "b.csv", "--without", "magic"], "magic"),
        (["a.csv", "b.csv", "--unexplained", "2"], "key 'unexplained' is 2"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(flags, words, capsys):
    write_log(Path("a.csv"), runs())
    Path("copy.csv").write_bytes(Path("a.csv").read_bytes())
    write_log(Path("b.csv"), runs(phase=1.0))
    write_log(Path("slow.csv"), runs(dt=0.02))
    write_log(Path("fast.csv"), runs(dt=0.005))
    assert main(["compare", *flags, "--out", "out"]) == 2
    output = capsys.readouterr().err
    assert words in output and output.count("\n") == 1 and not Path("out").exists()


def gap_of(closed: float, left: float) -> Gap:
    """A gap of twice the error, of which the share `closed` is closed."""
    errors = Errors(np.ones((4, 4, 3)), (0.01, 0.5, 1.0, 2.0), np.arange(4), np.arange(4))
    ratio = {"other": np.full((4, 4, 3), [2.0, 1.8, 2.2]), "nominal": np.full((4, 4, 3), [3.0, 2.8, 3.2])}
    share = Share(closed, (closed - 0.05, min(closed + 0.05, 1.0)), left, (left / 2, 2 * left))
    return Gap({"own": errors}, ratio, share, True)


def test_a_log_that_its_own_car_does_not_predict_measures_no_gap():
    """The observer may lose that car where the sideslip is not measured; predictions are of 1e22 then."""
    gap = gap_of(0.9, 0.1)
    lost = gap._replace(ratio={"other": 1e-5 * gap.ratio["other"], "nominal": 1e-5 * gap.ratio["nominal"]})
    assert "2.00 [1.80, 2.20] times the error of B's own" in gap_sentence(gap, "AB", True)
    assert gap_sentence(lost, "AB", True).startswith("The gap on B is not measured: its own car errs far more")


def difference(probability: float = 1.0, at_bound: bool = False) -> Difference:
    row = {
        "a": 0.0,
        "a_error": 0.01,
        "b": -0.3,
        "b_error": 0.01,
        "difference": -0.3,
        "ci95": [-0.33, -0.27],
        "unit": "1",
    }
    parameters = {"p": row | {"at_bound": at_bound}}
    return Difference("friction", probability, 0.001, parameters, {"mass": 1 - probability}, "tyres")


@pytest.mark.parametrize(
    ("one", "force_known", "closed", "left", "verdict"),
    [
        (difference(), True, 0.97, 0.02, "NAMED"),
        (difference(), False, 0.97, 0.02, "NAMED"),
        (difference(0.6), True, 0.97, 0.02, "SET"),
        (difference(at_bound=True), True, 0.97, 0.02, "SET"),
        (difference(), True, 0.3, 0.5, "UNKNOWN"),
        (difference(), True, 0.3, 0.05, "NAMED"),  # little is left, however significant
    ],
)
def test_the_verdict_is_about_names_and_about_what_is_left_of_the_gap(one, force_known, closed, left, verdict):
    pair: Any = SimpleNamespace(problems=[SimpleNamespace(data=SimpleNamespace(force_known=force_known))])
    gap = gap_of(closed, left)
    judgement = judge(pair, (one,), (gap, gap), {}, CompareConfig(), 30.0)
    assert judgement.verdict == verdict
    assert "The car of A predicts B with 2.00 [1.80, 2.20] times the error of B's own 1 s ahead" in judgement.sentence
    assert f"close {100 * closed:.0f} %" in judgement.sentence and "-0.3 ± 0.03" in judgement.sentence
    assert ("do not rule out mass (0.40)" in judgement.sentence) == (one.probability < 0.9)
    assert ("no drive force" in judgement.sentence) != force_known
    assert ("Something differs" in judgement.sentence) == (verdict == "UNKNOWN")


def test_ranges_that_hardly_overlap_are_reported():
    slow_and_fast = {"V": Overlap((5.0, 8.0), (9.0, 14.0), 0.04), "beta": Overlap((-0.1, 0.1), (-0.1, 0.2), 0.8)}
    (text,) = range_sentence(slow_and_fast)
    assert "V (4 %: 5 to 8 in A, 9 to 14 in B)" in text and "beta" not in text
    assert range_sentence({"beta": slow_and_fast["beta"]}) == []
