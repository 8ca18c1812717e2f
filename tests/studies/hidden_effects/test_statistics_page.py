"""The documentation's table of rates: one row per recorded run, older lines without `dirty` among them."""

import importlib
import json
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[3] / "docs"
RATES = {"named first": 0.96, "pair found": 0.9, "false alarm": 0.05, "absent, not NAMED": 0.85, "covered": 0.94}
OLD = {"date": "2000-01-02T03:04:05+00:00", "commit": "0123456789", "seed": 7, "rates": RATES,
       "cases": {"single": 100, "pair": 20, "none": 20, "absent": 20}}  # fmt: skip


@pytest.fixture
def rows(tmp_path, monkeypatch):
    """Return the table's lines for the runs of a made-up file."""
    monkeypatch.syspath_prepend(DOCS / "_ext")
    page = importlib.import_module("results").statistics_table

    def shown(*runs: dict) -> list[str]:
        (tmp_path / "results").mkdir(exist_ok=True)
        text = "".join(json.dumps(run) + "\n" for run in runs)
        (tmp_path / "results/hidden-effects-statistics.jsonl").write_text(text)
        return page(tmp_path).splitlines()

    return shown


def test_one_run_is_one_row_with_intervals_and_cases(rows):
    head, _, row = rows(OLD)
    assert "one: named first" in head and head.count("|") == row.count("|")
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:3] == ["2000-01-02 at 0123456", "7", "0.96\u00a0[0.90,\u00a00.98]\u00a0(100)"] and cells[-1] == "0.94"


def test_several_runs_keep_their_order_and_say_whether_files_had_changed(rows):
    shown = rows(OLD, OLD | {"dirty": False, "seed": 8}, OLD | {"dirty": True, "seed": 9})
    assert [row.split("|")[2].strip() for row in shown[2:]] == ["7", "8", "9"]
    assert ["with changes" in row for row in shown[2:]] == [False, False, True]


def test_a_table_without_runs_says_so(rows):
    assert rows() == ["No run is recorded yet."]


def test_the_recorded_runs_have_what_the_table_shows(rows):
    path = DOCS / "results/hidden-effects-statistics.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    runs = [json.loads(line) for line in lines]
    assert not runs or len(rows(*runs)) == 2 + len(runs)
