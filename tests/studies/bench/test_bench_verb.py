"""The bench: rows and table, peers that agree with this package or are reported as missing, the verb's files."""

import dataclasses
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.cli import main
from driftjax.control.mpc import MPCConfig
from driftjax.core import BadInput
from driftjax.environment import SERIAL_LOOPS
from driftjax.gp import Hyper
from driftjax.studies.bench import cpp_step, gp_rows, mpc_rows, simulator_rows
from driftjax.studies.bench.casadi_mpc import CasadiMPC
from driftjax.studies.bench.compile_rows import EVENTS, Spans
from driftjax.studies.bench.config import PARTS, BenchConfig, missing
from driftjax.studies.bench.drift import TOLERANCE, WEIGHTS, X_REF, car, config, starts
from driftjax.studies.bench.mpc import Solved
from driftjax.studies.bench.rows import Row, Timing, alternate, timed
from driftjax.studies.bench.run import environment
from driftjax.studies.bench.table import cells, markdown, seconds

QUICK = dataclasses.replace(BenchConfig(quick=True), plots=False).reduced()
SLOW, QUICKER = Timing((2.0, 4.0, 6.0)), Timing((1.0, 1.0, 2.0))


def row(**changes) -> Row:
    values = {"part": "gp", "what": "fit", "unit": "fit", "ours": QUICKER, "against": "peer", "theirs": SLOW, **changes}
    return Row(**values)


def test_ratios_are_of_runs_measured_one_after_the_other():
    faster = row(target=3.0)
    assert faster.ratio == Timing((2.0, 4.0, 3.0)) and faster.met
    assert not row(target=3.1).met
    costs = row(sense="costs", target=0.3)
    assert costs.ratio is not None and costs.ratio.median == pytest.approx(1 / 3) and not costs.met
    alone = row(sense="seconds", theirs=None, target=1.5)
    assert alone.ratio == QUICKER and alone.met
    assert row(theirs=None, missing="missing: pip install peer", target=3.0).met is None
    assert row().met is None


def test_the_table_tells_ratio_target_and_what_is_missing():
    line = cells(row(target=3.0, facts={"solved": 0.75, "remarks": "alike"}).as_json())
    assert line == ("gp", "fit", "1 s per fit", "peer", "4 s", "3 [2.5, 3.5]", ">= 3", "yes",
                    "solved to the tolerance 0.75; alike")  # fmt: skip
    gone = cells(row(theirs=None, missing="missing: pip install peer", target=3.0).as_json())
    assert gone[4:8] == ("missing: pip install peer", "-", ">= 3", "")
    lines = markdown([row().as_json()]).splitlines()
    assert len(lines) == 3 and len({line.count("|") for line in lines}) == 1
    assert [seconds(t) for t in (12.345, 0.0123, 4.56e-6, 7.8e-8, 3e-11)] == [
        "12.3 s",
        "12.3 ms",
        "4.56 us",
        "78 ns",
        "0.03 ns",
    ]


def test_measurements_alternate_and_short_calls_are_repeated_within_a_run(monkeypatch):
    """By a clock that only the calls advance, each by 10 us: 1 ms takes 100 of them."""
    order, calls = [], []
    runs = {name: lambda name=name: order.append(name) or 1.0 for name in ("a", "b")}
    assert alternate(2, runs) == {"a": Timing((1.0, 1.0)), "b": Timing((1.0, 1.0))}
    assert order == ["a", "b", "a", "b"]
    assert len(alternate(9, runs, budget=0.0)["a"].runs) == 3
    monkeypatch.setattr("time.perf_counter", lambda: 1e-5 * len(calls))
    run = timed(lambda: calls.append(0), units=10, at_least=1e-3)
    before = len(calls)
    per_unit = run()
    assert len(calls) - before in (100, 101) and per_unit == pytest.approx(1e-6)  # 101 by rounding


def test_spans_within_each_other_count_once(monkeypatch):
    clock = iter((2.0, 3.0, 10.0))
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    spans = Spans()
    spans(EVENTS[0], 1.0)  # 1 to 2, within the next
    spans(EVENTS[1], 3.0)  # 0 to 3
    spans(EVENTS[2], 2.0)  # 8 to 10
    spans("/jax/something/else", 5.0)
    assert spans.seconds() == pytest.approx(5.0)


@pytest.fixture
def hidden(monkeypatch):
    """Packages that cannot be found."""
    for name in ("casadi", "numba", "sklearn"):
        monkeypatch.setitem(sys.modules, name, None)


def test_missing_peers_are_reported(hidden, monkeypatch):
    """Every row stays, with how to install its peer; the row of g++ is still measured. Our own sides are stand-ins."""
    fake = lambda num: lambda: Solved(jnp.ones(num), jnp.ones(num, bool))
    monkeypatch.setattr(mpc_rows, "mpc_solves", lambda kind, problems, dtype, **_: fake(len(problems.x)))
    for name in ("single_track_steps", "double_track_steps"):
        monkeypatch.setattr(simulator_rows, name, lambda dtype, num, *_: lambda: 3 * (np.zeros(num),))
    fit = SimpleNamespace(gp=SimpleNamespace(hyper=Hyper(jnp.zeros((3, 5)), jnp.zeros(3), jnp.zeros(3))),
                          log_marginal_likelihood=np.zeros(3))  # fmt: skip
    monkeypatch.setattr(gp_rows, "gp_fit", lambda rows: lambda: fit)
    monkeypatch.setattr(gp_rows, "any_kernel", lambda rows: lambda: SimpleNamespace(log_marginal_likelihood=0.0))
    once = dataclasses.replace(QUICK, dtype=("float64",))
    rows = [row for part in (mpc_rows, simulator_rows, gp_rows) for row in part.measure_rows(once).rows]
    missing = {row.against: row.missing for row in rows}
    assert missing["CasADi FATROP"] == missing["CasADi IPOPT"] == "missing: pip install casadi"
    assert missing["numba, one core"] == "missing: pip install numba"
    assert missing["scikit-learn"] == "missing: pip install scikit-learn"
    assert all(row.ratio is None for row in rows if row.missing)
    assert all(row.ratio is not None for row in rows if not row.missing)


@pytest.fixture(scope="module")
def two_solvers() -> dict[str, list]:
    """Answers of FATROP and IPOPT to the first starts, on a short horizon."""
    problems, short = starts(8), config(6)
    peers = {name: CasadiMPC(name, car(), short, WEIGHTS, X_REF, TOLERANCE, compiled=False)
             for name in ("fatrop", "ipopt")}  # fmt: skip
    return {name: [peer.solve(x, u) for x, u in zip(*problems, strict=True)] for name, peer in peers.items()}


def test_fatrop_and_ipopt_agree(two_solvers):
    assert all(one.success for answers in two_solvers.values() for one in answers)
    fatrop, ipopt = ([one.cost for one in answers] for answers in two_solvers.values())
    np.testing.assert_allclose(fatrop, ipopt, rtol=1e-6)


def test_the_transcription_is_of_the_config_given(two_solvers):
    dear = MPCConfig(**{**dataclasses.asdict(config(6)), "R": (1000.0, 0.1)})
    peer = CasadiMPC("ipopt", car(), dear, WEIGHTS, X_REF, TOLERANCE, compiled=False)
    first = peer.solve(*(side[0] for side in starts(8)))
    assert first.success and first.cost > two_solvers["ipopt"][0].cost * 1.001


@pytest.mark.parametrize("dtype, within", [("float64", 1e-12), pytest.param("float32", 1e-5, marks=pytest.mark.slow)])
def test_peers_of_the_simulator_make_the_same_step(dtype, within):
    cfg = dataclasses.replace(QUICK, dtype=(dtype,))
    facts = [row.facts for row in simulator_rows.measure_rows(cfg).rows if "difference" in row.facts]
    assert len(facts) == 3 and all(fact["difference"] < within for fact in facts)


@pytest.mark.skipif(bool(missing("g++")), reason="no g++ here")
def test_loading_the_steps_in_cpp_leaves_denormal_numbers_alone():
    cpp_step.compiled("vector")
    assert (np.array([2e-308]) * 0.5)[0] > 0


def test_only_the_mpc_gets_more_threads():
    cfg = dataclasses.replace(QUICK, threads=2)
    mpc, gp = environment("mpc", cfg), environment("gp", cfg)
    assert mpc["NPROC"] == "2" and SERIAL_LOOPS not in mpc["XLA_FLAGS"]
    assert gp["NPROC"] == "1"


def test_bad_options_are_refused():
    with pytest.raises(BadInput, match="'repeats' is 0"):
        BenchConfig(repeats=0)
    with pytest.raises(BadInput, match="no quick form"):
        BenchConfig(only=("compile",), quick=True).reduced()


@pytest.mark.parametrize(
    "parts",
    [
        ("simulator", "gp"),
        pytest.param(tuple(part for part in PARTS if part != "compile"), marks=pytest.mark.slow),  # minutes
    ],
)
def test_a_quick_run_writes_all_rows(parts, tmp_path, capsys):
    assert main(["bench", "--quick", "--only", *parts, "--out", str(tmp_path / "b")]) == 0
    said = capsys.readouterr().out
    results = json.loads((tmp_path / "b/results.json").read_text())
    assert {row["part"] for row in results["rows"]} == set(parts)
    for row in results["rows"]:
        assert row["missing"] or row["ratio"]["median"] > 0
        assert row["ours"]["quartiles"][0] <= row["ours"]["median"] <= row["ours"]["quartiles"][1]
        assert row["facts"].get("solved", 1.0) == 1.0 and row["facts"].get("same_likelihood", True)
        assert all(row["facts"].get(f"cost_difference_{name}", 0.0) < 1e-3 for name in ("fatrop", "ipopt"))
        assert row["what"] in said and row["target"] is None
    assert results["machine"]["processor"] and results["machine"]["versions"]["jax"]
    table = (tmp_path / "b/results.md").read_text()
    assert table.count("\n| ") == len(results["rows"]) + 2 and "say nothing about speed" in table
    figures = {curve["figure"] for curve in results["curves"]}
    assert all(Path(tmp_path, f"b/figures/{name}.{kind}").stat().st_size > 5000
               for name in figures for kind in ("png", "pdf"))  # fmt: skip
