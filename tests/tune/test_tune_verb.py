"""`driftjax tune` with made-up laps: what it writes and says; bad input in one sentence."""

import json
from typing import Any

import numpy as np
import pytest

from driftjax.cli.front import main
from driftjax.learning.metrics import LapFigures
from driftjax.tune.laps import LapResults
from driftjax.tune.loss import LapGradients
from driftjax.tune.parameters import NAMES

FIGURES: Any = LapFigures  # of NumPy's arrays here
SLOPES: Any = LapGradients


class MadeUp:
    """Plants whose loss is least at another point each; the last one spins wherever the lead grows."""

    def __init__(self, config, scenario):
        del scenario
        self.config, self.untuned_drivers = config, None
        self.plants = [f"plant_{i}" for i in range(config.training + config.held_out)]

    def _aim(self, which):
        return np.array([[0.3 + 0.02 * i, -0.2, 0.1, 0.0, 0.0, -0.1] for i in range(len(self.plants))])[which]

    def drive(self, points, which):
        apart = points[:, None] - self._aim(which)
        spun = np.zeros(apart.shape[:2], bool)
        spun[:, -1] = points[:, 5] > 0.1
        loss = np.where(spun, self.config.scales.failed, np.sum(apart**2, axis=-1))
        return LapResults(loss, np.where(spun, 2, 1), FIGURES(loss, loss, loss, loss, ~spun, loss))

    def gradients(self, p, which):
        apart = p - self._aim(which)
        num = len(apart)
        return SLOPES(np.sum(apart**2, axis=1), 2 * apart, np.tile(2 * np.eye(6), (num, 1, 1)), np.ones(num, bool))


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("driftjax.tune.run.LapEvaluator", MadeUp)
    monkeypatch.setattr("driftjax.tune.run.build_scenario", lambda learn, executor: None)
    monkeypatch.setattr(
        "driftjax.tune.run.parameter_values", lambda drivers, p: dict(zip(NAMES, np.exp(p).tolist(), strict=True))
    )
    return tmp_path


def test_results_report_and_figure_are_written_and_the_gain_is_reported(here, capsys):
    assert main(["tune", "--out", "r", "--held-out", "3", "--budget", "30", "--workers", "1"]) == 0
    out = capsys.readouterr().out
    results = json.loads((here / "r" / "results.json").read_text())
    assert {"parameters", "box", "training_plants", "settings", "held_out"} == set(results)
    assert set(results["settings"]) == {"default", "tuned", "random"}
    tuned, drawn = results["settings"]["tuned"], results["settings"]["random"]
    assert tuned["cost"] <= drawn["cost"] == 30
    assert tuned["loss"] < 0.01 < drawn["loss"] <= results["settings"]["default"]["loss"]
    held = results["held_out"]
    assert [plant["plant"] for plant in held["plants"]] == ["plant_4", "plant_5", "plant_6"]
    assert not set(results["training_plants"]) & {plant["plant"] for plant in held["plants"]}
    low, high = held["loss_difference"]["tuned - default"]["ci95"]
    assert low < high < 0 and held["completed"]["tuned"] == 3
    for name in ("config.yaml", "versions.json", "report.txt", "figures/tuning.png", "figures/tuning.pdf"):
        assert (here / "r" / name).is_file()
    assert "Against random search, tuning by gradients lowers the mean loss" in out and "Laps that failed" in out
    assert (here / "r" / "report.txt").read_text().strip() in out


def test_where_random_search_wins_it_is_said(here, capsys, monkeypatch):
    none = SLOPES(np.zeros(1), np.zeros((1, 6)), np.zeros((1, 6, 6)), np.zeros(1, bool))
    monkeypatch.setattr(MadeUp, "gradients", lambda self, p, which: none)
    assert main(["tune", "--out", "r", "--budget", "60", "--workers", "1"]) == 0
    out = capsys.readouterr().out
    assert "Against random search, tuning by gradients does not lower the mean loss" in out
    assert "left out of a gradient: 1." in out


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--budget", "1"], "key 'budget' is 1"),
        (["--training", "0"], "key 'training' is 0"),
        (["--weights", "0.5"], "give a factor above 1"),
        (["--learn.switch.lead", "0"], "cannot be tuned by factors"),
        (["--learn.plant", "sedan"], "those of `tune` are drawn"),
        (["--workers", "0"], "key 'workers' is 0"),
        (["--car", "tram"], "tram: no such file"),
        (["--config", "absent.yaml"], "absent.yaml: no such file"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(argv, words, here, capsys):
    assert main(["tune", *argv]) == 2
    results_content = capsys.readouterr()
    assert (
        len(results_content.err.strip().splitlines()) == 1
        and words in results_content.err
        and results_content.out == ""
    )
    assert list(here.iterdir()) == []
