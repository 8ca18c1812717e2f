"""The report of a diagnosis: figures, gain table and page, from the run folder alone."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from driftjax.diagnosis.residual import FORCES
from driftjax.logs.columns import MEASURED
from driftjax.report.evidence import confusability, posterior, scores
from driftjax.report.html import document, folded, heading, paragraph, picture, text
from driftjax.report.predictions import error_over_horizon, fan
from driftjax.report.residuals import residual_forces, whiteness
from driftjax.report.style import save
from driftjax.report.table import aligned, interval, number
from driftjax.report.worth import waterfall, worth_table
from driftjax.store import RunFolder

TITLES = {
    "fan": ("Predictions beside the measurement", "Predictions start from the observer's state at the dots and then "
            "see commands only."),
    "error_over_horizon": ("Error over the horizon", "Dashed: what a right model would be off by, from sensor noise "
                           "and the disturbances that no effect explains, to first order: in an unstable drift that "
                           "grows beyond what a car can do. Dotted: the sensor noise alone."),
    "residual_forces": ("Residual forces", "Disturbances of the rates from all samples before and after, as forces of "
                        "each axle. Where the data say little they are told smaller than they are. An error of a "
                        "sensor shows as a force too; kinematic parity tells it from the car's."),
    "scores": ("Scores of all effects", "What the nominal car's errors say of each effect by itself. Where much is "
               "wrong many effects pass the test; the one that is named is worth most once refitted."),
    "worth": ("What each named effect is worth", "Shares of what all named effects explain of the squared error that a "
              "right model would not make; effects that explain the same share it alike (Shapley 1953)."),
    "posterior": ("Named effects and their rivals", ""),
    "confusability": ("Which effects look alike in these data", "Labels of named effects are red."),
    "whiteness": ("Whiteness before and after", "Innovations of a right model are not correlated in time."),
}  # fmt: skip


CLOSED_LOOP = ("lateral_error", "velocity_rmse", "drift_share")  # columns of its table


def figures(run: RunFolder) -> Iterator[tuple[str, Figure]]:
    """Name and figure of everything that the run has data for."""
    if not run.has("diagnosis.nc"):
        return
    data = run.read_dataset("diagnosis.nc")
    yield "fan", fan(data)
    yield "error_over_horizon", error_over_horizon(data)
    if (figure := residual_forces(data)) is not None:
        yield "residual_forces", figure
    yield "scores", scores(data)
    content = run.read_json("diagnosis")
    if (figure := waterfall(content)) is not None:
        yield "worth", figure
    if (figure := posterior(content)) is not None:
        yield "posterior", figure
    yield "confusability", confusability(data)
    yield "whiteness", whiteness(data)


def write_diagnosis(run: RunFolder) -> Path:
    """Write figures/*.png and .pdf and report.html from the folder alone; returns the page's path."""
    pictures = [save(figure, run.path / "figures", name) for name, figure in figures(run)]
    page = run.path / "report.html"
    page.write_text(_html(run, pictures), encoding="utf-8")
    return page


def _html(run: RunFolder, pictures: list[Path]) -> str:
    found = run.read_json("diagnosis")
    parts = [heading(found["verdict"]), paragraph(found["sentence"], strong=True)]
    shown = found.get("show")
    if worth := worth_table(found):
        parts += [heading("What each is worth"), text(worth)]
    if shown:
        parts += [paragraph(shown["worst"]), paragraph(parity_words(shown["kinematic_parity"]))]
        parts += [heading("Gain"), text(gain_table(found["gain"])), text(show_table(shown))]
    if found.get("closed_loop"):
        parts += [heading("Closed loop"), text(closed_loop_table(found["closed_loop"]))]
    parts += [picture(path, *TITLES[path.stem]) for path in pictures]
    if found.get("next_manoeuvre"):
        parts.append(folded("Next manoeuvre", found["next_manoeuvre"]))
    parts += [folded("Data and noise", found["data"]), folded("Configuration", run.config)]
    parts.append(folded("Versions", run.read_json("versions")))
    car = run.config.get("vehicle", {}).get("name", "")
    return document(f"driftjax diagnose: {car}".rstrip(": "), run.created, parts)


def parity_words(parity: dict[str, Any] | None) -> str:
    """What kinematic parity says, or why it says nothing."""
    if parity is None:
        return "Kinematic parity was not looked at: the log has no ax, ay."
    return str(parity["statement"])


def gain_table(gain: dict[str, Any]) -> str:
    """Open-loop errors on the runs held out, per model and horizon: in units, all three over those of the nominal car,
    and the share of the explainable error removed."""
    if not gain["held_out_runs"]:
        return "gain: not measured, for want of runs to hold out.\n"
    lines = [f"open-loop error (RMS) on the runs held out: {', '.join(gain['held_out_runs'])}"]
    lines += [f"{'model':12}{'after [s]':>10}{'V [m/s]':>10}{'beta [rad]':>12}{'r [rad/s]':>11}   "
              f"{'over nominal':20}explainable removed"]  # fmt: skip
    for name, channels in gain["rmse"].items():
        for i, horizon in enumerate(gain["horizons_s"]):
            values = "".join(
                number(channels[c][i], ".4f").rjust(w) for c, w in zip(MEASURED, (10, 12, 11), strict=True)
            )
            ratio = share = ""
            if name in gain["ratio"]:
                ratio = _within(gain["ratio"][name][i], *gain["ratio_ci95"][name][i], "-")
            if horizon == gain.get("skill_horizon_s", 1.0) and name in gain["skill"]:
                share = _within(gain["skill"][name], *gain["ci95"][name], "nothing to explain beyond noise")
            lines.append(f"{name:12}{horizon:10.3g}{values}   {ratio:20}{share}".rstrip())
    return "\n".join(lines) + "\n"


def _within(value: float | None, low: float | None, high: float | None, missing: str) -> str:
    """A number with its interval, or what is told where there is none."""
    return missing if value is None else f"{value:.2f} [{low:.2f}, {high:.2f}]"


def closed_loop_table(driven: dict[str, Any]) -> str:
    """Laps of the same corner on one plant with each model in the MPC, and how they differ, seed by seed."""
    lines = [
        f"closed loop: the {driven['corner']} corner on {driven['plant']}, path-tracking drift MPC before any learning"
    ]
    rows: list[tuple[str, ...]] = [
        ("model", "lateral error [m]", "speed RMSE [m/s]", "drift share", "completed", "failures")
    ]
    for name, laps in driven["models"].items():
        if "not_driven" in laps:
            lines.append(f"{name}: not driven; {laps['not_driven']}")
            continue
        failed = [code.lower().replace("_", " ") for code in laps["codes"] if code != "COMPLETED"]
        done, of = laps["completed"]
        means = (number(laps[key]["mean"], ".3f") for key in CLOSED_LOOP)
        rows.append((name, *means, f"{done}/{of}", ", ".join(failed) or "none"))
    if driven["difference"]:
        apart = (interval(driven["difference"][key], ".3f") for key in CLOSED_LOOP)
        rows.append(("extended less nominal", *apart, "", ""))
    lines += aligned(rows)
    lines.append("Errors are against each model's own plan. In brackets: 95 % interval over seeds of the sensor noise.")
    return "\n".join(lines) + "\n"


def show_table(shown: dict[str, Any]) -> str:
    """Errors of the nominal car on all runs in units of the measurement noise, and its residual forces."""
    ahead = shown["open_loop"]
    lines = ["open-loop error of the nominal car on all runs, in units of the measurement noise"]
    lines.append(f"{'after [s]':>10}{'V':>8}{'beta':>8}{'r':>8}")
    for i, horizon in enumerate(ahead["horizons_s"]):
        values = (ahead["in_noises"][name][i] for name in MEASURED)
        lines.append(f"{horizon:10.3g}" + "".join(number(value).rjust(8) for value in values))
    lines += ["", "residual forces (RMS)", f"{'force':>10}{'nominal [N]':>13}{'extended [N]':>14}   goes with most"]
    for name in FORCES:
        one = shown["residual_forces"][name]
        by = one["worst_variable"]
        share = f"{by} ({100 * one['explained'][by]:.0f} % of the variance)" if by else "-"
        lines.append(f"{name:>10}{one['rms_N']:13.4g}{one['rms_extended_N']:14.4g}   {share}")
    return "\n".join(lines) + "\n"
