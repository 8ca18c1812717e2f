"""Tables on the pages of results come from committed files, which say when and how they were measured."""

import json
import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
INCLUDED = re.compile(r"\{include\} \.\./generated/(table-\S+)\.md")
TYPED = {"paper": 1, "real-logs": 1}  # tables of words: what an ablation is, what a reader of a log says


@pytest.fixture
def recorded(monkeypatch) -> dict[str, str]:
    """The tables by name, as the documentation has them."""
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    monkeypatch.delitem(sys.modules, "results", raising=False)
    from results import recorded_tables

    return recorded_tables(DOCS)


def test_every_recorded_table_is_on_one_page(recorded):
    pages = [name for path in DOCS.glob("results/*.md") for name in INCLUDED.findall(path.read_text(encoding="utf-8"))]
    assert sorted(pages) == sorted(recorded)


def test_pages_of_results_have_no_typed_numbers():
    heads = {path.stem: len(re.findall(r"(?m)^\|[ :-]*--", path.read_text())) for path in DOCS.glob("results/*.md")}
    assert {page: num for page, num in heads.items() if num} == TYPED


@pytest.mark.parametrize("path", sorted(DOCS.glob("results/*-tables.json")), ids=lambda path: path.stem)
def test_a_recorded_table_says_where_it_is_from(path):
    for found in json.loads(path.read_text(encoding="utf-8")).values():
        assert {"date", "commit", "command", "device"} <= set(found["measured"])
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", found["measured"]["date"])
        assert {len(row) for row in found["rows"]} == {len(found["head"])}


def test_cells_keep_their_digits(recorded):
    assert "| MPC, real-time iteration | 4096 | 6.8 us (1.5e5) | 378 |" in recorded["table-speed-gpu"]
    assert recorded["table-speed-gpu"].startswith("Measured 2026-11-26 at commit f0e50ca on one NVIDIA H200")
