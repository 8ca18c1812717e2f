"""Run the bench: every part in a process of its own, then the table, the JSON and the figures.

One part in this process: `python -m driftjax.studies.bench.run PART OPTIONS OUT`, with JSON files.
"""

import importlib
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax

from driftjax.core import from_dict, write_text
from driftjax.core.config import to_dict
from driftjax.core.progress import ProgressReport
from driftjax.environment import FUSED_RESULTS, SERIAL_LOOPS, fuses_results, with_flag, with_pass
from driftjax.studies.bench.config import BenchConfig, Part
from driftjax.studies.bench.figures import write_curves
from driftjax.studies.bench.machine import machine
from driftjax.studies.bench.table import bench_page

ROOT = Path(__file__).resolve().parents[3]


def run_bench(cfg: BenchConfig, out: Path, report: ProgressReport) -> dict[str, Any]:
    """Measure all parts of `cfg`; writes results.json, results.md and figures to `out`, and returns the results."""
    cfg = cfg.reduced() if cfg.quick else cfg
    results: dict[str, Any] = {"machine": machine(), "options": to_dict(cfg), "rows": [], "curves": []}
    out.mkdir(parents=True, exist_ok=True)
    for number, part in enumerate(cfg.only):
        report(part, number, len(cfg.only))
        part_results = run_part(part, cfg)
        # at these sizes the targets mean nothing
        results["rows"] += (
            [row | {"target": None, "met": None} for row in part_results["rows"]] if cfg.quick else part_results["rows"]
        )
        results["curves"] += part_results["curves"]
        write_results(results, out)  # what is measured is kept whatever comes next
    report("done", len(cfg.only), len(cfg.only))
    write_curves(results["curves"], out)
    return results


def write_results(results: dict[str, Any], out: Path) -> None:
    """Write results.json and results.md so far."""
    text, table = json.dumps(results, indent=1), bench_page(results)
    write_text(out / "results.json", text)
    write_text(out / "results.md", table)


def run_part(part: Part, cfg: BenchConfig) -> dict[str, Any]:
    """Measure one part in a process of its own; returns its rows and curves."""
    with tempfile.TemporaryDirectory(prefix="driftjax-bench-") as folder:
        options, out = Path(folder) / "options.json", Path(folder) / "out.json"
        options.write_text(json.dumps(to_dict(cfg)), encoding="utf-8")
        command = [sys.executable, "-m", "driftjax.studies.bench.run", part, str(options), str(out)]
        done = subprocess.run(command, cwd=folder, env=environment(part, cfg), stderr=subprocess.PIPE, text=True)
        if done.returncode != 0:
            raise RuntimeError(f"part {part} ended with code {done.returncode}: {done.stderr.strip()[-2000:]}")
        return json.loads(out.read_text(encoding="utf-8"))


def measure_part(part: str, options: Path, out: Path) -> None:
    """Measure `part` in this process with the config in `options`; rows and curves go to `out`."""
    cfg = from_dict(BenchConfig, json.loads(options.read_text(encoding="utf-8")), str(options))
    result = importlib.import_module(f"driftjax.studies.bench.{part}_rows").measure_rows(cfg)
    content = {"rows": [row.as_json() for row in result.rows], "curves": [asdict(curve) for curve in result.curves]}
    out.write_text(json.dumps(content), encoding="utf-8")


def environment(part: Part, cfg: BenchConfig) -> dict[str, str]:
    """Return the environment of the part's process: this copy of the package first, one thread per peer."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    # only these programs are free of the LAPACK calls with which XLA's client can deadlock on several threads
    elementwise = ("mpc", "simulator")
    threads = str(cfg.threads if part in elementwise else 1)
    own = {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NPROC": threads}
    if part in (*elementwise, "controller") and jax.default_backend() == "cpu":
        flags = os.environ.get("XLA_FLAGS", "")
        if part in elementwise:  # their loops may be shared by threads
            flags = with_pass(flags, SERIAL_LOOPS)
        own["XLA_FLAGS"] = with_flag(flags, FUSED_RESULTS).strip() if fuses_results() else flags.strip()
    cache = jax.config.values["jax_compilation_cache_dir"]
    return {**os.environ, **own} | ({"JAX_COMPILATION_CACHE_DIR": str(cache)} if cache else {})


if __name__ == "__main__":
    measure_part(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
