"""`driftjax report RUN`: rebuild figures, table and page of a run from its folder."""

import dataclasses
from pathlib import Path

import tyro

from driftjax.cli.console import parse
from driftjax.core import from_dict
from driftjax.report import results_table, write_page, write_plan_figures
from driftjax.store import RunFolder


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Rebuild figures, table and report.html of a run from its folder alone."""

    run: tyro.conf.Positional[Path]
    """Run folder."""


def run(argv: list[str]) -> int:
    """Rebuild and print the table."""
    folder = RunFolder.open(parse(ReportOptions, argv, "driftjax report").run)
    if folder.verb == "plan":
        print("\n".join(map(str, write_plan_figures(folder.read_dataset("plan.nc"), folder.path))))
        return 0
    if folder.verb == "paper":
        return _paper(folder)
    page = write_page(folder)
    if folder.verb == "learn" and folder.has("results.json"):
        print(results_table(folder.read_json("results")))
    print(f"report: {page}")
    return 0


def _paper(folder: RunFolder) -> int:
    """Rebuild tables and figures of a comparison."""
    from driftjax.studies.paper.config import PaperConfig
    from driftjax.studies.paper.run import rebuild
    from driftjax.studies.paper.table import paper_page

    results = rebuild(from_dict(PaperConfig, folder.config, str(folder.path / "config.yaml")), folder)
    print(paper_page(results), end="")
    return 0
