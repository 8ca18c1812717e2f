"""Write the page of a run of any verb."""

from pathlib import Path

from driftjax.core import BadInput
from driftjax.report.diagnosis_page import write_diagnosis
from driftjax.report.learn import write_report
from driftjax.report.log_comparison import write_comparison
from driftjax.store import RunFolder

WRITERS = {"learn": write_report, "diagnose": write_diagnosis, "compare": write_comparison}


def write_page(folder: RunFolder | str | Path) -> Path:
    """Write the figures and report.html of a run of learn, diagnose or compare; returns the page's path.

    Raises `BadInput` for a run of another verb.
    """
    run = RunFolder.open(folder)
    if run.verb not in WRITERS:
        raise BadInput(
            f"{run.path}: a run of `driftjax {run.verb}` has no report.html; take one of learn, diagnose or compare."
        )
    return WRITERS[run.verb](run)
