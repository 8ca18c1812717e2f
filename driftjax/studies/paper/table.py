"""Format results.md: the comparison in tables."""

from typing import Any

from driftjax.report.table import CONTROLLERS, format_interval, markdown_table, number
from driftjax.studies.paper.credit import CONTRASTS, VARIANTS
from driftjax.studies.paper.statistics import ALONE, METHODS, TARGETS

HEAD = {
    "lateral_error": ("lateral error [m]", ".3f"),
    "lateral_error_max": ("largest [m]", ".2f"),
    "velocity_rmse": ("speed RMSE [m/s]", ".2f"),
    "beta_rmse": ("sideslip RMSE [rad]", ".3f"),
    "r_rmse": ("yaw rate RMSE [rad/s]", ".2f"),
    "lap_time": ("lap time [s]", ".2f"),
    "completed": ("completed", ".2f"),
    "drifted": ("and sideways", ".2f"),
}
PARTS = ("entry", "reference", "tracking")
GAINS = {
    "gpr": "lateral error, GPR against nominal [%]",
    "exploration": "lateral error, explored against GPR [%]",
    "exploration_velocity": "speed RMSE, explored against GPR [%]",
    "best_error": "lateral error of the best method [m]",
    "best_drifted": "its laps completed, sideways over half of the section",
}


def paper_page(results: dict[str, Any]) -> str:
    """Return all tables, in Markdown."""
    split = results["split"]
    first, last = split["plants"][0], split["plants"][-1]
    lines = [
        f"Plants {first} to {last} (seed {split['seed']}, half: {split['half'].replace('_', ' ')}), "
        f"{split['noise_seeds']} noise seed{'s' if split['noise_seeds'] > 1 else ''} each. Lateral errors are against "
        "the planned minimum-time path, over the planned drift section; what a failed lap misses of it counts with the "
        "distance at which a lap is lost. In brackets: 95 % intervals over plants by Student's t, of reductions "
        "paired and on the log ratio of means. (n/N): of the n plants of N that have the figure.",
        "",
    ]
    for car, result in results["cars"].items():
        lines += [f"### {car}", ""]
        if "methods" in result:
            lines += [f"Settings: SHA-256 {result['settings'][:16]}.", ""]
            lines += _targets(result["targets"]) + _methods(result["methods"]) + _parts(result)
            lines += _feasible(result["feasible"]) if result["feasible"] else []
        lines += _credit(result["credit"], car) if result["credit"] else []
        lines += _choosers(result) if result.get("choosers") else []
        lines += _ablations(result["ablations"]) if result["ablations"] else []
    return "\n".join(lines).rstrip() + "\n"


def _rows(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    return [*markdown_table([head, *rows]), ""]


def _targets(targets: list[dict[str, Any]]) -> list[str]:
    rows = []
    for row in targets:
        form = ".1f" if row["name"] in ("gpr", "exploration", "exploration_velocity") else ".3f"
        of = row.get("of")
        words = GAINS[row["name"]] + (f" ({CONTROLLERS[of[0]]}, {METHODS[of[1]]})" if of else "")
        sign = "<=" if row["name"] == "best_error" else ">="
        rows.append((words, format_interval(row, form), f"{sign} {row['aim']:g}", "yes" if row["met"] else "no"))
    return _rows(("the paper's controller; the best of both", "measured", "aim", "met"), rows)


def _methods(methods: dict[str, Any]) -> list[str]:
    rows = [
        (
            words if name in ALONE else f"{words}, {CONTROLLERS[who]}",
            *(format_interval(stages[name][figure], form) for figure, (_, form) in HEAD.items()),
        )
        for who, stages in methods.items()
        for name, words in METHODS.items()
        if name in stages and (who == "paper" or name not in ALONE)
    ]
    return _rows(("method", *(words for words, _ in HEAD.values())), rows)


def _parts(result: dict[str, Any]) -> list[str]:
    """Return the parts of the lateral error, and how often the GP is evaluated far from its data."""
    rows = []
    for who, stages in result["methods"].items():
        for name in stages:
            if name not in ALONE:
                far = result["extrapolation"][who].get(name)
                parts = (format_interval(stages[name][part], ".3f") for part in PARTS)
                error = format_interval(stages[name]["lateral_error"], ".3f")
                rows.append((name, CONTROLLERS[who], error, *parts, "-" if far is None else f"{far:.2f}"))
    head = ("laps", "controller", "lateral error [m]", "in the first third", "of the reference itself",
            "against the reference", "share far from the GP's data")  # fmt: skip
    return _rows(head, rows)


def _feasible(feasibility: dict[str, Any]) -> list[str]:
    """Return whether the plants, as learnt, can drive the planned speed and yaw rate."""
    rows = []
    for who in (who for who in CONTROLLERS if who in feasibility):
        mean, low, high = (number(value, ".3f") for value in feasibility[who]["speed"])
        shares = (f"{feasibility[who][name]:.2f}" for name in ("exists", "steady"))
        rows.append((CONTROLLERS[who], *shares, f"{mean} ({low} to {high})"))
    head = (
        "nominal car with the GP learnt on each plant",
        f"share with a drift at V_b {feasibility['V_b']:.2f} m/s and r_b {feasibility['r_b']:.2f} rad/s",
        "share with one at the planned sideslip and radius",
        "its speed over V_b: mean (least to largest)",
    )
    return _rows(head, rows)


def _credit(credit: dict[str, Any], car: str) -> list[str]:
    """Return the tables of the causes of the gain: the variants, then the contrasts between them."""
    variants = [
        (VARIANTS[name][0], CONTROLLERS[who], format_interval(cell["lateral_error"], ".3f"),
         format_interval(cell["velocity_rmse"], ".2f"), format_interval(cell["completed"], ".2f"))
        for who, credited in credit.items() for name, cell in credited["rungs"].items()
    ]  # fmt: skip
    rows: list[tuple[str, ...]] = []
    for who, credited in credit.items():
        for name, cell in credited["contrasts"].items():
            aim = TARGETS[car].get(name.removesuffix("_gross")) if who == "paper" else None
            gains = (format_interval(cell[key], ".0f") for key in ("percent", "velocity_percent"))
            metres = format_interval(cell["metres"], "+.3f")
            rows.append((CONTRASTS[name].words, CONTROLLERS[who], metres, *gains, number(aim, "g")))
        if "interaction" in credited:
            words = "interaction: V-sets beside the correction less V-sets alone"
            rows.append((words, CONTROLLERS[who], format_interval(credited["interaction"], "+.3f"), "-", "-", "-"))
    text = [
        "Who owns the gain: all rows have the same plants and noise, as many GPR laps and, where explored, as many "
        "exploration laps. The single layer has as many laps of data as the double layer here; in the main comparison "
        "it has one. Without GP its mean is zero in the reference and in the MPC.",
        "",
    ]
    change = ("gain of", "controller", "change of lateral error [m]", "reduction [%]", "of speed RMSE [%]",
              "Wu et al. [%]")  # fmt: skip
    variant_head = ("driven", "controller", "lateral error [m]", "speed RMSE [m/s]", "completed")
    return [*text, *_rows(variant_head, variants), *_rows(change, rows)]


def _choosers(result: dict[str, Any]) -> list[str]:
    """Return the error of the best lap so far against the number of exploration laps, by what chooses them."""
    rows: list[tuple[str, ...]] = []
    most = max(len(one["error"]) for cell in result["choosers"].values() for one in cell["curves"].values())
    for who, cell in result["choosers"].items():
        for name, curve in cell["curves"].items():
            errors = [format_interval(one, ".3f") for one in curve["error"]]
            less = format_interval(cell.get("against", {}).get(name, [{}])[-1], ".0f")
            words, regret = result["ablations"][name]["words"], format_interval(curve["regret"][-1], ".3f")
            rows.append((words, CONTROLLERS[who], *errors, *["-"] * (most - len(errors)), regret, less))
    laps = (f"after {num} lap{'s' if num > 1 else ''}" for num in range(1, most))
    head = ("chosen by", "controller", "before exploration [m]", *laps, "regret at the end [m]",
            "less by the knowledge gradient [%]")  # fmt: skip
    text = [
        "Error of the best lap so far, by what chooses the exploration laps. The best lap is the one with the least "
        "measured error, its true error is stated; regret is to the best lap of all rules on the same plant. All rules "
        "have the same correction of the path.",
        "",
    ]
    return [*text, *_rows(head, rows)]


def _ablations(ablations: dict[str, Any]) -> list[str]:
    rows = []
    for result in ablations.values():
        for who, stages in result["methods"].items():
            cells = [format_interval(stages[name]["lateral_error"], ".3f") if name in stages else "-"
                     for name in ("nominal", "gpr-best", "explore-best")]  # fmt: skip
            ends = [stages[name]["completed"] for name in ("gpr-best", "explore-best") if name in stages]
            done = ", ".join(f"{end['mean']:.2f}" for end in ends)
            gains = (format_interval(result["gains"][who][name], ".0f") for name in ("gpr", "exploration"))
            rows.append((result["words"], CONTROLLERS[who], *cells, *gains, done))
    head = ("ablation", "controller", "nominal [m]", "GPR [m]", "explored [m]", "by GPR [%]", "by exploration [%]",
            "completed: GPR, explored")  # fmt: skip
    notes = [
        f"{result['words'][0].upper()}{result['words'][1:]}, from 60 s of the car that the plants are drawn around: "
        f"{result['diagnosis']['verdict']}. {result['diagnosis']['sentence']}"
        for result in ablations.values()
        if "diagnosis" in result
    ]
    return _rows(head, rows) + [line for words in notes for line in (words, "")]
