"""Plot the open-loop predictions of a diagnosis: beside the measurement, and their error over the horizon."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from driftjax.report.style import COMPARED, legend_below, new_figure

CHANNELS = {
    "V": ("speed V [m/s]", 1.0),
    "beta": ("sideslip beta [deg]", 180 / np.pi),
    "r": ("yaw rate r [deg/s]", 180 / np.pi),
}
SHOWN = ("nominal", "extended")
WIDTHS = {"nominal": 2.2, "extended": 1.3}  # of lines that may cover each other


def drawn_models(data: xr.Dataset) -> list[str]:
    """Return the models to draw: the extended one only where an effect was named."""
    return list(SHOWN) if data["named"].values.any() else ["nominal"]


def _starts(axis: Axes, times: np.ndarray, rows: np.ndarray, **style: Any) -> None:
    """Plot predictions (start, ahead) from every start, each until it leaves the panel."""
    low, high = axis.get_ylim()
    left = np.cumsum((rows < low) | (rows > high), axis=1) > 1
    gap = np.full((len(rows), 1), np.nan)  # so that one line holds all of them
    axis.plot(np.hstack([times, gap]).ravel(), np.hstack([np.where(left, np.nan, rows), gap]).ravel(), **style)


def plot_predictions(data: xr.Dataset) -> Figure:
    """Plot measured channels and the predictions of each model from some starts, a column per run."""
    panels = data["panel"].values
    figure, axes = new_figure(3, len(panels), (max(4.6 * len(panels), 7.5), 7.2), sharex="col")
    times = data["start_time"].values[:, None] + data["ahead_time"].values
    for column, name in enumerate(panels):
        one = data.isel(panel=column)
        end = data["sample_time"].values[np.isfinite(one["measured"].values).any(axis=1)].max()
        for axis, (channel, (label, factor)) in zip(axes[:, column], CHANNELS.items(), strict=True):
            measured = one["measured"].sel(channel=channel).values * factor
            axis.plot(data["sample_time"], measured, color="0.72", lw=2.6, label="measured")
            shown = measured if np.isfinite(measured).any() else one["predicted"].sel(channel=channel).values * factor
            axis.set_ylim(_room(shown, 8 * float(data["sigma"].sel(channel=channel)) * factor))
            for model in drawn_models(data):
                colour, words = COMPARED[model]
                rows = one["predicted"].sel(model=model, channel=channel).values * factor
                _starts(axis, times, rows, color=colour, lw=WIDTHS[model], label=f"predicted, {words}")
            axis.plot(data["start_time"], np.interp(data["start_time"], data["sample_time"], measured),
                      "o", color="black", ms=3, label="start of a prediction")  # fmt: skip
            if column == 0:
                axis.set_ylabel(label)
            axis.set_xlim(0, end)
        axes[0, column].set_title(str(name))
        axes[-1, column].set_xlabel("time t [s]")
    legend_below(figure, axes[0, 0], 4)
    figure.suptitle(f"Open-loop predictions on {data.attrs['predicted_on']}", fontsize=10.5)
    figure.align_ylabels()
    return figure


def _room(measured: np.ndarray, least: float) -> tuple[float, float]:
    """Return limits half a range beyond the values, so that a diverging prediction does not flatten them."""
    low, high = float(np.nanmin(measured)), float(np.nanmax(measured))
    room = 0.5 * max(high - low, least)
    return low - room, high + room


def plot_error_over_horizon(data: xr.Dataset) -> Figure:
    """Plot the RMS error of every model over the time ahead, with the noise floor."""
    figure, axes = new_figure(1, 3, (11.0, 4.0))
    named = data["named"].values.any()
    models = [str(name) for name in data["compared"].values if named or name != "extended"]
    for axis, (channel, (label, factor)) in zip(axes[0], CHANNELS.items(), strict=True):
        errors = data["rmse"].sel(channel=channel) * factor
        if not np.isfinite(errors).any():
            axis.text(
                0.5, 0.5, f"{label.split(' ')[0]}: nothing to compare with", ha="center", transform=axis.transAxes
            )
            axis.set_axis_off()
            continue
        for model in models:
            colour, words = COMPARED[model]
            axis.plot(data["horizon"], errors.sel(compared=model), color=colour, label=words)
        floor = data["floor"].sel(channel=channel) * factor
        axis.plot(data["horizon"], floor, color="black", ls="--", lw=1.2, label="a right model")
        sigma = float(data["sigma"].sel(channel=channel)) * factor
        axis.axhline(sigma, color="0.5", ls=":", lw=1.2, label="measurement noise")
        axis.set(xlabel="time ahead [s]", ylabel=f"RMS error of {label}")
        axis.set_xlim(0, float(data["horizon"][-1]))
        axis.set_yscale("log")
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.set_ylim(0.7 * sigma, 1.5 * max(float(errors.max()), sigma))
    legend_below(figure, axes[0, 2], 5)
    figure.suptitle(f"Open-loop error on {data.attrs['predicted_on']}", fontsize=10.5)
    return figure
