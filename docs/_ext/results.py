"""Tables of results as MyST Markdown, from committed result files."""

import json
from pathlib import Path
from typing import Any

from tables import table

from driftjax.report.style import COMPARED, stage_label
from driftjax.report.table import CONTROLLERS, REDUCTIONS, format_interval, number, with_interval
from driftjax.studies.hidden_effects.score import rate_interval

# rates of `pytest -m statistics`: what a column is called, and the kind of cases that it is a share of
RATES = {
    "named first": ("one: named first", "single"),
    "pair found": ("two: both named", "pair"),
    "false alarm": ("nothing: an effect was named", "none"),
    "absent, not NAMED": ("one that the catalogue lacks: not NAMED", "absent"),
    "covered": ("parameters inside their 95 % intervals", None),
}


def learn_tables(docs: Path) -> str:
    """Return the stages and reductions of the run of `driftjax learn` below docs/results/."""
    read = lambda name: json.loads((docs / "results" / f"learn-{name}.json").read_text(encoding="utf-8"))
    results, versions = read("results"), read("versions")
    rows = []
    for stage in results["stages"]:
        for controller, entry in stage["controllers"].items():
            done, of = entry["completed"]
            rows.append((stage_label(stage["name"]), CONTROLLERS.get(controller, controller),
                         format_interval(entry["lateral_error"]), format_interval(entry["velocity_rmse"]),
                         number(entry["drift_share"]["mean"]), f"{done}/{of}"))  # fmt: skip
    head = ("stage", "controller", "lateral error [m]", "speed RMSE [m/s]", "drift share", "completed")
    summary = results["summary"]["path"]
    reductions = [(words, format_interval(summary[key], ".1f"), number(summary[key]["paper"], ".1f"))
                  for key, words in REDUCTIONS.items()]  # fmt: skip
    tables = table(head, rows), table(("reduction [%]", "this run", "Wu et al. 2025"), reductions)
    return "\n".join([f"Measured {_origin(versions)}.", "", *tables])


NAMED_BY = {"single steps": "single steps", "predictions": "an observer of long memory"}
SIZES = {"likelihood": "the likelihood", "predictions": "predictions"}


def real_log_tables(docs: Path) -> str:
    """Return the diagnoses in docs/results/real-logs.json, which `python -m experiments.real_logs` wrote."""
    results = json.loads((docs / "results/real-logs.json").read_text(encoding="utf-8"))
    parts = []
    for name, entry in results.items():
        gain, ahead = entry["gain"], entry["gain"]["skill_horizon_s"]
        if gain["skill"]["extended"] is None:
            explained = f"whether the nominal car errs by more than noise {ahead:g} s ahead is in doubt"
        else:
            removed = with_interval(*(_percent(gain[key]["extended"]) for key in ("skill", "ci95")), ".0f")
            explained = f"the named effects remove {removed} % of the excess error {ahead:g} s ahead"
        parts += [f"### `{name}`\n", f"Measured {_origin(entry['measured'])}. Verdict {entry['verdict']}; effects are "
                  f"named by {NAMED_BY[entry['named_by']]}, sizes fitted to {SIZES[entry['sizes_fitted_to']]}; "
                  f"{explained}.\n"]  # fmt: skip
        parts += [f"To compare with other work: `{key}` {with_interval(one['value'], one['ci95'])}, "
                  f"{'inside' if one['as_known'] else 'outside'} its range.\n"
                  for key, one in entry["answer"].items() if one["as_known"] is not None]  # fmt: skip
        rows = [(f"`{one['effect']}`" + " (exploratory)" * one["exploratory"], number(100 * one["share"], ".1f"),
                 "; ".join(_parameter(*pair) for pair in one["parameters"].items()))
                for one in entry["causes"]]  # fmt: skip
        parts.append(table(("effect", "share [%]", "value, with its 95 % interval"), rows))
        at = gain["horizons_s"].index(ahead)
        errors = [(COMPARED[model][1], *(f"{gain['rmse'][model][channel][at]:#.2g}" for channel in ("V", "beta", "r")))
                  for model in ("nominal", "retuned", "extended")]  # fmt: skip
        parts.append(table((f"error {ahead:g} s ahead", "V [m/s]", "beta [rad]", "r [rad/s]"), errors))
    return "\n".join(parts)


def statistics_table(docs: Path) -> str:
    """Return the rates of every run in docs/results/hidden-effects-statistics.jsonl, the oldest first."""
    path = docs / "results/hidden-effects-statistics.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    rows = [_statistics_row(json.loads(line)) for line in lines if line.strip()]
    if not rows:
        return "No run is recorded yet.\n"
    return table(("measured", "seed", *(words for words, _ in RATES.values())), rows)


def recorded_tables(docs: Path) -> dict[str, str]:
    """Return each table of docs/results/PAGE-tables.json with its origin, by the name table-PAGE-KEY.

    Cells are text, so that no digit is lost; a commit, command or device that is null was not recorded.
    """
    pages = {}
    for path in sorted((docs / "results").glob("*-tables.json")):
        page = path.stem.removesuffix("-tables")
        for key, entry in json.loads(path.read_text(encoding="utf-8")).items():
            wrong = [row for row in entry["rows"] if len(row) != len(entry["head"])]
            assert not wrong, f"{path.name}, {key}: {wrong} have not as many cells as the head"
            pages[f"table-{page}-{key}"] = f"{_measured(entry['measured'])}\n\n{table(entry['head'], entry['rows'])}"
    return pages


def _measured(origin: dict[str, str | None]) -> str:
    words = [f"Measured {origin['date']}"]
    words += [f"at commit {origin['commit']}"] if origin["commit"] else []
    words += [f"on {origin['device']}"] if origin["device"] else []
    words += [f"with `{origin['command']}`"] if origin["command"] else []
    return " ".join(words) + f". {origin.get('note') or ''}".rstrip()


def _statistics_row(run: dict[str, Any]) -> tuple[str, ...]:
    changed = " with changes" * bool(run.get("dirty"))
    cells = [f"{run['date'][:10]} at {run['commit'][:7]}{changed}", str(run["seed"])]
    for key, (_, kind) in RATES.items():
        rate, num = run["rates"][key], run["cases"].get(kind)
        ends = rate_interval(round(rate * num), num) if num else None
        cells.append(with_interval(rate, ends, ".2f") + (f" ({num})" if num else ""))
    return tuple(cells)


def _parameter(name: str, entry: dict[str, Any]) -> str:
    unit = "" if entry["unit"] == "1" else f" {entry['unit']}"
    bound = ", at its bound" * entry["at_bound"]
    return f"{name} = {with_interval(entry['value'], entry['ci95'], '.3g')}{unit}{bound}"


def _percent(value: Any) -> Any:
    return [100 * one for one in value] if isinstance(value, list) else 100 * value


def _origin(versions: dict[str, str]) -> str:
    return f"{versions['created'][:10]} at commit {versions['commit'][:7]}"
