"""What is asked of one result, or of all results of a kind: was it named, first, exactly; is the interval right."""

from typing import Any

import numpy as np
from scipy.stats import kstest

from driftjax.diagnosis.select import PARAMETER_PENALTY
from driftjax.studies.hidden_effects.drivers import DRIVERS

LARGEST_SET = 3  # effects that a reported set may hold to count as an answer
BINS = 5  # of the probability
Result = dict[str, Any]


def hidden_in(result: Result) -> list[str]:
    """Names of the hidden effects."""
    return [one["name"] for one in result["case"]["effects"]]


def reported_set(cause: dict[str, Any]) -> list[str]:
    """A cause with the rivals that it is reported with."""
    return [cause["effect"], *cause["rivals"]]


def named_first(result: Result) -> bool:
    """Whether the hidden effect was named before any other, or the set reported instead is small and holds it."""
    if not result["causes"]:
        return False
    (name,), cause = hidden_in(result), result["causes"][0]
    inseparable = result["verdict"] == "SET" and len(reported_set(cause)) <= LARGEST_SET and name in reported_set(cause)
    return cause["effect"] == name or inseparable


def named_alone(result: Result) -> bool:
    """Whether all hidden effects and nothing else were named, and the verdict is NAMED."""
    return result["verdict"] == "NAMED" and named_exactly(result)


def resolved_by_manoeuvre(result: Result) -> bool:
    """Whether the hidden effect alone is sure, once the manoeuvre proposed is driven."""
    return named_alone(result["after"])


def misnamed(result: Result) -> bool:
    """Whether something else was named without a doubt."""
    return result["verdict"] == "NAMED" and not named_first(result)


def named_exactly(result: Result) -> bool:
    """Whether all hidden effects were named and nothing else."""
    return set(result["named"]) == set(hidden_in(result))


def named_all(result: Result) -> bool:
    """Whether all hidden effects were named."""
    return set(result["named"]) >= set(hidden_in(result))


def interval_hits(result: Result) -> list[bool]:
    """Of each parameter of a hidden effect that was named: whether its interval holds the truth."""
    named = [one for one in result.get("hidden", ()) if "theta" in one]
    rows = [zip(one["strengths"], one["theta"], one["half_width"], strict=True) for one in named]
    return [abs(true - theta) <= half for row in rows for true, theta, half in row]


def removed_shares(results: list[Result]) -> list[float]:
    """Skill over the truth's own, where an effect was named and the truth's skill is beyond doubt."""
    counted = [r for r in results if r["named"] and "oracle" in r and r["oracle"][1] > 0]
    return [r["skill"]["extended"][0] / r["oracle"][0] for r in counted]


def imitates_truth(result: Result) -> bool:
    """Whether what was named in place of a missing effect fits no worse than the truth, but for one parameter."""
    return result["verdict"] == "NAMED" and result["prices"]["named"] <= result["prices"]["truth"] + PARAMETER_PENALTY


def driver_found(result: Result) -> bool:
    """Whether a driving variable of the missing effect is among the first two that are told: of what is left, or of
    all that the nominal car gets wrong where nothing is."""
    told = result["unexplained"]["drivers"] or result["unexplained"]["at_first"]
    return any(variable in DRIVERS[name] for name in hidden_in(result) for variable in told)


def height_within_tolerance(result: Result) -> bool:
    """Whether the height of load transfer is within 15 % of the file's, or in a reported set."""
    for cause in result["causes"]:
        if cause["effect"] == "load_transfer_long":
            return abs(cause["theta"][0] * cause["scale"][0] / result["height"] - 1) < 0.15
        if "load_transfer_long" in reported_set(cause):
            return True
    return False


def named_any(result: Result) -> bool:
    """Whether anything was named."""
    return bool(result["named"])


def naive_right(result: Result) -> bool:
    """Whether the one-step regression names the hidden effect."""
    return result.get("naive") in hidden_in(result)


def worse_than_nominal(result: Result) -> bool:
    """Whether the extended car predicts runs held out worse than the nominal one."""
    return "extended" in result["skill"] and result["skill"]["extended"][0] < 0


def calibration_error(results: list[Result]) -> float:
    """Expected calibration error: distance of probabilities from how often they are right, over bins."""
    pairs = np.array([(c["probability"], c["effect"] in hidden_in(r)) for r in results for c in r["causes"]], float)
    if not len(pairs):
        return float("nan")
    bins = np.minimum((pairs[:, 0] * BINS).astype(int), BINS - 1)
    gaps = [len(p) * abs(p[:, 0].mean() - p[:, 1].mean()) for k in range(BINS) if len(p := pairs[bins == k])]
    return float(sum(gaps) / len(pairs))


def uniformity_p_value(none: list[Result]) -> float:
    """p-value of the hypothesis that p-values of logs without effects are uniform (Kolmogorov and Smirnov)."""
    return float(kstest([r["p_first"] for r in none], "uniform").pvalue) if none else float("nan")
