"""What `driftjax learn` spends on tracing, lowering and compiling, with an empty compilation cache and a full one."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from driftjax.studies.bench.config import Config
from driftjax.studies.bench.rows import Measured, Row, Timing

TARGET = 45.0  # seconds


def learn(folder: Path, name: str) -> dict[str, float]:
    """A run with the cache in `folder`: seconds spent on programs, and in all."""
    out = folder / f"{name}.json"
    command = [sys.executable, "-m", "driftjax.studies.bench.compiling", str(out), str(folder / name)]
    own = {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run(command, env={**os.environ, **own}, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"learning ended with code {done.returncode}: {done.stderr.strip()[-2000:]}")
    return json.loads(out.read_text(encoding="utf-8"))


def measure(cfg: Config) -> Measured:
    """One row, measured once: it takes minutes."""
    del cfg
    with tempfile.TemporaryDirectory(prefix="driftjax-bench-") as folder:
        empty, full = learn(Path(folder), "empty"), learn(Path(folder), "full")
    words = f"the whole run of one plant in one process: {empty['all']:.3g} s, then {full['all']:.3g} s"
    facts = {"empty": empty, "full": full, "remarks": words}
    return Measured([Row("compile", "driftjax learn: tracing, lowering, compiling, with an empty cache", "run",
                         Timing((empty["programs"],)), "the same with a full cache", Timing((full["programs"],)),
                         "seconds", TARGET, facts=facts)])  # fmt: skip
