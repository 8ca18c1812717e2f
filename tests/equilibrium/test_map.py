"""The map of equilibria as a person runs it, in small."""

import csv

import numpy as np
import pytest
from scipy_steady_states import balance

from driftjax.core import BadInput
from driftjax.equilibrium.map import MapConfig, write_map
from driftjax.vehicle import load_vehicle


def test_map_and_table_are_written_and_true(tmp_path):
    numbers = write_map(MapConfig(vehicle="rc", num_V=3, num_ratio=3, ratio_min=0.8, ratio_max=1.1), tmp_path)
    assert (tmp_path / "equilibria.png").stat().st_size > 10_000
    with (tmp_path / "equilibria.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == numbers["steady_states"] and numbers["unconfirmed"] == 0
    c = load_vehicle("rc")
    for row in rows:
        point = [float(row[key]) for key in ("V", "beta", "r", "delta", "Fxr")]
        assert np.max(np.abs(balance(c, *point))) < 1e-6
    assert {"grip", "countersteer", "front_saturated"} <= {row["branch"] for row in rows}
    assert 1 / 3 <= numbers["share_with_grip"] <= 2 / 3 and numbers["lowest_drift_ratio"] == pytest.approx(1.1)


def test_a_map_upside_down_is_refused():
    with pytest.raises(BadInput, match="ratio_max"):
        MapConfig(ratio_min=1.2, ratio_max=1.0)
