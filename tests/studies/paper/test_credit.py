"""Who owns the gain: contrasts of synthetic ablations whose errors are known."""

from typing import Any

import numpy as np
import pytest

from driftjax.studies.paper.credit import CONTRASTS, SQUARE, VARIANTS, WATERFALL, credit
from driftjax.studies.paper.figures import write_figures
from driftjax.studies.paper.statistics import summarise_figures
from driftjax.studies.paper.table import paper_page

ERRORS = {"nominal": 0.8, "lags": 0.7, "arrival": 0.6, "gp_reference": 0.5, "gp_mpc": 0.4, "both": 0.3,
          "parameters": 0.35, "tuned": 0.28, "laps": 0.25, "sets": 0.24, "correction": 0.1, "all": 0.12,
          "correction_only": 0.55}  # fmt: skip
PLANTS = np.array([0.7, 0.9, 1.1, 1.3])  # the error of each is that many times the mean


def ablations(*without: str) -> dict[str, Any]:
    """Ablations as in results.json, of which the variants in `without` were not driven."""
    content: dict[str, Any] = {}
    for variant, error in ERRORS.items():
        _, name, stage = VARIANTS[variant]
        if variant in without:
            continue
        figures = {"lateral_error": error * PLANTS, "velocity_rmse": 2 * error * PLANTS, "completed": np.ones(4)}
        one = content.setdefault(name, {"words": name, "methods": {"paper": {}}, "gains": {"paper": {}}})
        one["methods"]["paper"][stage] = summarise_figures(figures)
        one["gains"]["paper"] = dict.fromkeys(("gpr", "exploration"))
    return content


def results(*without: str) -> dict[str, Any]:
    """Results of a comparison without its main part."""
    content = ablations(*without)
    split = {"seed": 6, "half": "held_out", "plants": [4, 5, 6, 7], "noise_seeds": 1}
    return {"split": split, "cars": {"sedan": {"ablations": content, "credit": credit(content)}}}


def test_gains_are_paired_differences_of_the_variants_that_they_compare():
    credited = credit(ablations())["paper"]
    assert list(credited["rungs"]) == list(VARIANTS) and list(credited["contrasts"]) == list(CONTRASTS)
    for name, (_, before, after) in CONTRASTS.items():
        cell, change = credited["contrasts"][name], ERRORS[after] - ERRORS[before]
        assert cell["metres"]["mean"] == pytest.approx(change) and cell["metres"]["pairs"] == 4
        half = 3.18245 * abs(change) * PLANTS.std(ddof=1) / 2  # Student's t with three degrees of freedom
        np.testing.assert_allclose(cell["metres"]["ci95"], [change - half, change + half], rtol=1e-4)
        for figure in ("percent", "velocity_percent"):  # the same share on every plant: nothing left to vary
            assert cell[figure]["value"] == pytest.approx(-100 * change / ERRORS[before])
            assert np.ptp(cell[figure]["ci95"]) < 1e-6
    assert credited["interaction"]["mean"] == pytest.approx((0.12 - 0.1) - (0.24 - 0.25))


def test_the_waterfall_leads_from_nominal_to_explored_without_a_gap():
    steps = [CONTRASTS[name] for name in WATERFALL]
    assert steps[0].before == "nominal" and steps[-1].after == "all"
    assert all(one.after == other.before for one, other in zip(steps, steps[1:], strict=False))
    metres = [credit(ablations())["paper"]["contrasts"][name]["metres"]["mean"] for name in WATERFALL]
    assert sum(metres) == pytest.approx(ERRORS["all"] - ERRORS["nominal"])


def test_what_was_not_driven_is_credited_with_nothing():
    credited = credit(ablations("lags", "sets"))["paper"]
    assert "interaction" not in credited
    left = {name for name, (_, *ends) in CONTRASTS.items() if not {"lags", "sets"} & set(ends)}
    assert set(credited["contrasts"]) == left
    assert credit({}) == {} and credit(ablations(*(name for name in VARIANTS if name != "lags"))) == {}


def test_net_gains_stand_beside_those_of_the_paper_and_the_figure_is_drawn(tmp_path):
    words = paper_page(results())
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in words.splitlines() if line.startswith("|")]
    net = {row[0]: row for row in rows if row[0].startswith("**by")}
    gpr, exploration = net[CONTRASTS["gpr"].words], net[CONTRASTS["exploration"].words]
    assert gpr[3].startswith("50 [50") and gpr[-1] == "52.8"
    assert exploration[2].startswith("+0.020 [") and exploration[3].startswith("-20 [") and exploration[-1] == "27.1"
    assert "Plants 4 to 7" in words and all(VARIANTS[name][0] in words for name in SQUARE.values())
    paths = write_figures(results(), tmp_path)
    assert [path.name for path in paths] == ["credit_sedan.png"]
    assert all(paths[0].with_suffix(kind).stat().st_size > 10000 for kind in (".png", ".pdf"))
    assert write_figures(results("parameters"), tmp_path) == []
