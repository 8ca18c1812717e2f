"""Tables of results as MyST Markdown, from the committed `results.json` and `versions.json` of a run."""

import json
from pathlib import Path

from options import table

from driftjax.report.style import stage_label
from driftjax.report.table import CONTROLLERS, REDUCTIONS, interval, number


def learn_tables(docs: Path) -> str:
    """Return the stages and reductions of the run of `driftjax learn` below docs/results/."""
    read = lambda name: json.loads((docs / "results" / f"learn-{name}.json").read_text(encoding="utf-8"))
    results, versions = read("results"), read("versions")
    rows = []
    for stage in results["stages"]:
        for controller, found in stage["controllers"].items():
            done, of = found["completed"]
            rows.append((stage_label(stage["name"]), CONTROLLERS.get(controller, controller),
                         interval(found["lateral_error"]), interval(found["velocity_rmse"]),
                         number(found["drift_share"]["mean"]), f"{done}/{of}"))  # fmt: skip
    head = ("stage", "controller", "lateral error [m]", "speed RMSE [m/s]", "drift share", "completed")
    summary = results["summary"]["path"]
    reductions = [(words, interval(summary[key], ".1f"), number(summary[key]["paper"], ".1f"))
                  for key, words in REDUCTIONS.items()]  # fmt: skip
    origin = f"Measured {versions['created'][:10]} at commit {versions['commit'][:7]}."
    return "\n".join(
        [origin, "", table(head, rows), table(("reduction [%]", "this run", "Wu et al. 2025"), reductions)]
    )
