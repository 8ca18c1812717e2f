"""Plot the unexplained errors of a model: residual forces of each axle, and the whiteness of innovations."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from driftjax.report.predictions import WIDTHS, drawn_models
from driftjax.report.style import COMPARED, legend_below, new_figure

FORCES = {"Fx": "longitudinal force\n[% of mu Fzr]", "Fyf": "front lateral force\n[% of mu Fzf]",
          "Fyr": "rear lateral force\n[% of mu Fzr]"}  # fmt: skip
DRIVERS = {
    "slip_front": ("front slip [deg]", 180 / np.pi), "slip_rear": ("rear slip [deg]", 180 / np.pi),
    "drive": ("drive force [kN]", 1e-3), "speed": ("speed [m/s]", 1.0), "time": ("time [s]", 1.0),
    "heading": ("heading [deg]", 180 / np.pi), "position": ("position [m]", 1.0),
}  # fmt: skip
NEWTON = 0.2  # of kilonewtons below which a car's drive force is drawn in newtons


def plot_residual_forces(data: xr.Dataset) -> Figure | None:
    """Plot mean residual forces in bins with 95 % intervals, a row per known force, a column per variable."""
    drivers = [str(name) for name in data["driver"].values]
    if not drivers:
        return None
    forces = [force for force in FORCES if bool(data["bin_mean"].sel(force=force).notnull().any())]
    size = max(1.75 * len(drivers) + 1.2, 6.0), 1.9 * len(forces) + 0.7
    figure, axes = new_figure(len(forces), len(drivers), size, sharex="col", sharey="row")
    for row, force in enumerate(forces):
        limit = float(data["force_limit"].sel(force=force)) / 100
        for column, driver in enumerate(drivers):
            axis = axes[row, column]
            words, factor = DRIVERS[driver]
            if driver == "drive" and float(np.abs(data["bin_value"].sel(driver=driver)).max()) * factor < NEWTON:
                words, factor = "drive force [N]", 1.0
            for model in drawn_models(data):
                colour, name = COMPARED[model]
                one = data.sel(model=model, driver=driver)
                share = float(one["explained"].sel(force=force))
                mean, error = (one[key].sel(force=force).values / limit for key in ("bin_mean", "bin_error"))
                width = WIDTHS[model]
                axis.errorbar(one["bin_value"].values * factor, mean, 1.96 * error, color=colour, fmt="o-",
                              ms=2 * width, lw=width, elinewidth=0.7 * width, label=name)  # fmt: skip
                if model == "nominal":
                    axis.set_title(f"explains {100 * share:.0f} %", fontsize=8.5, pad=3,
                                   fontweight="bold" if share > 0.25 else "normal")  # fmt: skip
            axis.axhline(0, color="0.4", lw=0.7)
            if row == len(forces) - 1:
                axis.set_xlabel(words)
        axes[row, 0].set_ylabel(FORCES[force])
    legend_below(figure, axes[0, 0], 2)
    figure.suptitle("Residual forces: what each axle does beyond the model (95 % intervals); above each panel the"
                    " share of the nominal\nresidual's variance that the variable explains", fontsize=10.5)  # fmt: skip
    figure.align_ylabels()
    return figure


def plot_whiteness(data: xr.Dataset) -> Figure:
    """Plot the autocorrelation of whitened innovations with the 95 % band of a correct model."""
    figure, axes = new_figure(1, 3, (11.0, 3.6), sharey=True)
    band = data.attrs["white_band"]
    for axis, channel in zip(axes[0], ("V", "beta", "r"), strict=True):
        axis.axhspan(-band, band, color="0.85", lw=0, label="95 % of a right model's")
        axis.axhline(0, color="0.4", lw=0.7)
        for model in drawn_models(data):
            colour, words = COMPARED[model]
            values = data["autocorrelation"].sel(model=model, channel=channel)
            axis.plot(data["lag_time"], values, color=colour, lw=1.3, label=words)
        axis.set(xlabel="lag [s]", title=f"innovations of {channel}")
        axis.set_xlim(0, float(data["lag_time"][-1]))
    axes[0, 0].set_ylabel("autocorrelation [-]")
    legend_below(figure, axes[0, 0], 3)
    return figure
