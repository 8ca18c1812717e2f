"""A diagnosis drives the manoeuvre that it proposes on a simulated car, and goes on with the longer log."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import driftjax as dj
from driftjax.diagnosis.verdict import Judgement, Verdict
from driftjax.manoeuvres.truth import write_truth


def test_the_manoeuvre_proposed_joins_the_log_that_was_diagnosed(tmp_path):
    vehicle, campaign = dj.load_vehicle("sedan", combined_slip=1.0), dj.Campaign(("slalom",), duration=5.0)
    runs, truth = dj.record_runs(vehicle, dj.effect_strengths(vehicle), campaign)
    dj.write_log(tmp_path / "log.csv", runs)
    write_truth(tmp_path / "truth.yaml", truth, "sedan", 1.0, campaign)
    evidence: Any = SimpleNamespace(proposal=SimpleNamespace(manoeuvre="slalom"))
    files = tmp_path / "truth.yaml", tmp_path / "next.csv"
    short = dj.Diagnosis(vehicle, dj.Log(runs), dj.DiagnoseConfig(), Judgement(Verdict.SET, ""), evidence)
    with pytest.raises(dj.BadInput, match="came from no file; write it"):
        short.drive_proposal(*files)
    longer = dataclasses.replace(short, log=dj.read_log(tmp_path / "log.csv")).drive_proposal(*files)
    assert longer.paths == (tmp_path / "log.csv", tmp_path / "next.csv") and len(longer.runs) == 2
    assert longer.runs[1].V.shape == longer.runs[0].V.shape and not np.allclose(longer.runs[1].V, longer.runs[0].V)
    with pytest.raises(dj.BadInput, match="proposes no manoeuvre"):
        dataclasses.replace(short, evidence=None).drive_proposal(*files)
