"""One part, measured in this process: `python -m driftjax.studies.bench.part PART OPTIONS OUT`, with JSON files."""

import importlib
import json
import sys
from dataclasses import asdict
from pathlib import Path

MODULES = {
    name: f"driftjax.studies.bench.{name}_rows" for name in ("mpc", "simulator", "gp", "plan", "laps", "compile")
}


def main(part: str, options: Path, out: Path) -> None:
    """Measure `part` with the config in `options`; rows and curves go to `out`."""
    from driftjax.core import from_dict
    from driftjax.studies.bench.config import Config

    cfg = from_dict(Config, json.loads(options.read_text(encoding="utf-8")), str(options))
    found = importlib.import_module(MODULES[part]).measure(cfg)
    content = {"rows": [row.as_json() for row in found.rows], "curves": [asdict(curve) for curve in found.curves]}
    out.write_text(json.dumps(content), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
