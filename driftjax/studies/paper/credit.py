"""Attribute the gain to its causes: contrasts of ablations that differ in one change, paired over plants."""

from typing import Any, NamedTuple

import numpy as np

from driftjax.learning.metrics import difference, reduction

GPR, EXPLORED = "gpr-best", "explore-best"
VARIANTS = {  # name: (words, ablation, stage whose laps are judged)
    "nominal": ("nominal MPC, as many laps", "nominal", GPR),
    "lags": ("+ learnt lags", "lags", GPR),
    "arrival": ("+ measured arrival", "arrival", GPR),
    "gp_reference": ("+ GP in the reference", "gp_reference", GPR),
    "gp_mpc": ("+ GP in the MPC instead: single layer, as many laps", "gp_mpc", GPR),
    "both": ("+ GP in both: double layer", "zero_mean", GPR),
    "parameters": ("+ tyre and drive parameters instead of a GP", "parameters", GPR),
    "tuned": ("+ parameters, and the GP of what they leave, in both", "as_it_is", GPR),
    "laps": ("+ more laps: planned speed, path not corrected", "planned_uncorrected", EXPLORED),
    "sets": ("+ as many laps: V-sets, path not corrected", "sets_uncorrected", EXPLORED),
    "correction": ("+ as many laps: planned speed, path corrected", "planned", EXPLORED),
    "all": ("+ as many laps: V-sets, path corrected", "as_it_is", EXPLORED),
    "correction_only": ("as many laps without GP: planned speed, path corrected", "arrival", EXPLORED),
}


class ArmContrast(NamedTuple):
    """Name of a gain, and the two variants whose errors it compares."""

    words: str
    before: str
    after: str


CONTRASTS = {
    "lags": ArmContrast("learnt lags", "nominal", "lags"),
    "arrival": ArmContrast("measured arrival", "lags", "arrival"),
    "gp_reference": ArmContrast("GP in the reference", "arrival", "gp_reference"),
    "gp_mpc_after": ArmContrast("GP in the MPC, beside the reference", "gp_reference", "both"),
    "parameters": ArmContrast("tyre and drive parameters", "arrival", "parameters"),
    "gp_after": ArmContrast("GP, beside the parameters", "parameters", "tuned"),
    "parameters_after": ArmContrast("parameters, beside the GP", "both", "tuned"),
    "laps": ArmContrast("more laps of data alone", "tuned", "laps"),
    "correction": ArmContrast("correction of the path", "laps", "correction"),
    "sets_after": ArmContrast("V-sets, beside the correction", "correction", "all"),
    "gp_mpc": ArmContrast("GP in the MPC alone", "arrival", "gp_mpc"),
    "gp_reference_after": ArmContrast("GP in the reference, beside the MPC", "gp_mpc", "both"),
    "sets": ArmContrast("V-sets alone", "laps", "sets"),
    "correction_after": ArmContrast("correction of the path, beside V-sets", "sets", "all"),
    "correction_only": ArmContrast("correction of the path, without GP", "arrival", "correction_only"),
    "gpr_gross": ArmContrast("lags, arrival and GP of zero mean", "nominal", "both"),
    "gpr": ArmContrast("**by GPR** of zero mean, net of lags and arrival", "arrival", "both"),
    "tuned_gross": ArmContrast("all of the GPR laps: lags, arrival, parameters and GP", "nominal", "tuned"),
    "exploration_gross": ArmContrast("all of the exploration laps: data, correction and V-sets", "tuned", "all"),
    "exploration": ArmContrast("**by exploration**, net of the correction", "correction", "all"),
}
WATERFALL = ("lags", "arrival", "parameters", "gp_after", "laps", "correction", "sets_after")
SQUARE = {("planned", "off"): "laps", ("planned", "on"): "correction", ("sets", "off"): "sets", ("sets", "on"): "all"}


def credit(ablations: dict[str, Any]) -> dict[str, Any]:
    """Return per controller the variants that the finished `ablations` drove, and the contrasts between two of them.

    Lateral errors are mean lap errors [m]; gains are paired over plants, with 95 % intervals by Student's t.
    """
    controllers = dict.fromkeys(who for one in ablations.values() for who in one["methods"])
    credits = {who: _credit(ablations, who) for who in controllers}
    return {who: one for who, one in credits.items() if one["contrasts"]}


def _credit(ablations: dict[str, Any], who: str) -> dict[str, Any]:
    variants: dict[str, Any] = {}
    for name, (_, ablation, stage) in VARIANTS.items():
        figures = ablations.get(ablation, {}).get("methods", {}).get(who, {}).get(stage)
        if figures:
            variants[name] = {key: figures[key] for key in ("lateral_error", "velocity_rmse", "completed")}
    values = lambda name, figure="lateral_error": np.asarray(variants[name][figure]["per_plant"], float)
    contrasts = {
        name: {
            "metres": difference(values(before), values(after)),
            "percent": reduction(values(before), values(after)),
            "velocity_percent": reduction(values(before, "velocity_rmse"), values(after, "velocity_rmse")),
        }
        for name, (_, before, after) in CONTRASTS.items()
        if before in variants and after in variants
    }
    credited = {"rungs": variants, "contrasts": contrasts}
    if all(name in variants for name in SQUARE.values()):
        alone, beside = values("sets") - values("laps"), values("all") - values("correction")
        credited["interaction"] = difference(alone, beside)
    return credited
