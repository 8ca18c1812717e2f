"""Figures and tables of a diagnosis, from the run folder alone."""

from collections.abc import Iterator
from typing import Any

from matplotlib.figure import Figure

from driftjax.diagnosis.residual import FORCES
from driftjax.logs.columns import MEASURED
from driftjax.report.error_share import plot_error_shares
from driftjax.report.evidence import plot_confusability, plot_posterior, plot_scores
from driftjax.report.predictions import plot_error_over_horizon, plot_predictions
from driftjax.report.residuals import plot_residual_forces, plot_whiteness
from driftjax.report.table import aligned, format_interval, number, with_interval
from driftjax.report.tyre_curve import plot_tyre_curves
from driftjax.store import RunFolder

TITLES = {
    "fan": ("Predictions beside the measurement", "Predictions start from the observer's state at the dots and then "
            "see commands only."),
    "error_over_horizon": ("Error over the horizon", "Dashed: what a right model would be off by, from sensor noise "
                           "and the disturbances that no effect explains, to first order: in an unstable drift that "
                           "grows beyond what a car can do. Dotted: the sensor noise alone."),
    "residual_forces": ("Residual forces", "Disturbances of the rates from all samples before and after, as forces of "
                        "each axle. Where the data have little information they are underestimated. An error of a "
                        "sensor shows as a force too; kinematic parity tells it from the car's."),
    "scores": ("Scores of all effects", "What the nominal car's errors say of each effect by itself. Where much is "
               "wrong many effects pass the test; the one that is named explains most once refitted."),
    "worth": ("Share of each named effect in the explained error", "Shares of what all named effects explain of "
              "the squared error that a right model would not make; effects that explain the same share it alike "
              "(Shapley 1953)."),
    "tyre_curves": ("Side force over slip", "At static load without drive, of the nominal car and with all named "
                    "effects, over the slips that the log covers. The band is a 95 % interval."),
    "posterior": ("Named effects and their rivals", ""),
    "confusability": ("Which effects look alike in these data", "Labels of named effects are red."),
    "whiteness": ("Whiteness before and after", "Innovations of a right model are not correlated in time."),
}  # fmt: skip


GAIN_HEAD = ("model", "after [s]", "V [m/s]", "beta [rad]", "r [rad/s]", "over nominal", "explainable removed")
NO_SKILL = "nothing to explain beyond noise"
CLOSED_LOOP = ("lateral_error", "velocity_rmse", "drift_share")  # columns of its table


def diagnosis_figures(run: RunFolder) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of everything that the run has data for."""
    if not run.has("diagnosis.nc"):
        return
    data = run.read_dataset("diagnosis.nc")
    yield "fan", plot_predictions(data)
    yield "error_over_horizon", plot_error_over_horizon(data)
    if (figure := plot_residual_forces(data)) is not None:
        yield "residual_forces", figure
    yield "scores", plot_scores(data)
    content = run.read_json("diagnosis")
    if (figure := plot_error_shares(content)) is not None:
        yield "worth", figure
    if (figure := plot_tyre_curves(content)) is not None:
        yield "tyre_curves", figure
    if (figure := plot_posterior(content)) is not None:
        yield "posterior", figure
    yield "confusability", plot_confusability(data)
    yield "whiteness", plot_whiteness(data)


def parity_statement(parity: dict[str, Any] | None) -> str:
    """Return the statement of kinematic parity, or why there is none."""
    if parity is None:
        return "Kinematic parity was not looked at: the log lacks ax, ay or a measured sideslip."
    return str(parity["statement"])


def gain_rows(gain: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the errors on held-out runs per model and horizon, their ratio to nominal, and the skill; head first."""
    rows: list[tuple[str, ...]] = [GAIN_HEAD]
    for name, channels in gain["rmse"].items():
        for i, horizon in enumerate(gain["horizons_s"]):
            values = (number(channels[c][i], ".4f") for c in MEASURED)
            ratio = share = ""
            if name in gain["ratio"]:
                ratio = with_interval(gain["ratio"][name][i], gain["ratio_ci95"][name][i])
            if horizon == gain.get("skill_horizon_s", 1.0) and name in gain["skill"]:
                share = with_interval(gain["skill"][name], gain["ci95"][name], missing=NO_SKILL)
            rows.append((name, f"{horizon:.3g}", *values, ratio, share))
    return rows


def gain_table(gain: dict[str, Any]) -> str:
    """Format the open-loop errors on held-out runs per model and horizon, their ratio to nominal, and the skill."""
    if not gain["held_out_runs"]:
        return "gain: not measured, for want of runs to hold out.\n"
    lines = [f"open-loop error (RMS) on the runs held out: {', '.join(gain['held_out_runs'])}"]
    return "\n".join([*lines, *aligned(gain_rows(gain))]) + "\n"


def closed_loop_rows(driven: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the laps of one corner with each model in the MPC, and their paired difference; head first."""
    rows: list[tuple[str, ...]] = [
        ("model", "lateral error [m]", "speed RMSE [m/s]", "drift share", "completed", "failures")
    ]
    for name, laps in driven["models"].items():
        if "not_driven" in laps:
            continue
        failed = [code.lower().replace("_", " ") for code in laps["codes"] if code != "COMPLETED"]
        done, of = laps["completed"]
        means = (number(laps[key]["mean"], ".3f") for key in CLOSED_LOOP)
        rows.append((name, *means, f"{done}/{of}", ", ".join(failed) or "none"))
    if driven["difference"]:
        apart = (format_interval(driven["difference"][key], ".3f") for key in CLOSED_LOOP)
        rows.append(("extended less nominal", *apart, "", ""))
    return rows


def closed_loop_notes(driven: dict[str, Any]) -> list[str]:
    """Return notes: the laps driven, models without laps, and the meaning of the errors."""
    notes = [
        f"closed loop: the {driven['corner']} corner on {driven['plant']}, path-tracking drift MPC before any learning"
    ]
    notes += [f"{name}: not driven; {laps['not_driven']}" for name, laps in driven["models"].items()
              if "not_driven" in laps]  # fmt: skip
    return [
        *notes,
        "Errors are against each model's own plan. In brackets: 95 % interval over seeds of the sensor noise.",
    ]


def closed_loop_table(driven: dict[str, Any]) -> str:
    """Format the laps of one corner on one plant with each model in the MPC, and their paired difference."""
    *notes, last = closed_loop_notes(driven)
    return "\n".join([*notes, *aligned(closed_loop_rows(driven)), last]) + "\n"


def nominal_error_rows(shown: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the errors of the nominal car on all runs in units of the measurement noise; head first."""
    ahead = shown["open_loop"]
    return [("after [s]", *MEASURED)] + [
        (f"{horizon:.3g}", *(number(ahead["in_noises"][name][i]) for name in MEASURED))
        for i, horizon in enumerate(ahead["horizons_s"])
    ]


def residual_force_rows(shown: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the RMS residual forces of the nominal and the extended car; head first."""
    rows = [("force", "nominal [N]", "extended [N]", "goes with most")]
    for name in FORCES:
        one = shown["residual_forces"][name]
        by = one["worst_variable"]
        share = f"{by} ({100 * one['explained'][by]:.0f} % of the variance)" if by else "-"
        rows.append((name, number(one["rms_N"], ".4g"), number(one["rms_extended_N"], ".4g"), share))
    return rows
