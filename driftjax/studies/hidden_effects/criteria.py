"""Criteria of one result, or of all results of a kind: named at all, first, exactly; interval correct."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.stats import kstest

from driftjax.diagnosis.select import PARAMETER_PENALTY
from driftjax.studies.hidden_effects.driving_variables import DRIVING_VARIABLES

LARGEST_SET = 3  # effects that a reported set may hold to count as an answer
BINS = 5  # of the probability
Result = dict[str, Any]


def hidden_in(result: Result) -> list[str]:
    """Return the names of the hidden effects."""
    return [one["name"] for one in result["case"]["effects"]]


def reported_set(cause: dict[str, Any]) -> list[str]:
    """Return a cause with its reported rivals."""
    return [cause["effect"], *cause["rivals"]]


def named_first(result: Result) -> bool:
    """Return whether the hidden effect was named first, or is in a small reported set."""
    if not result["causes"]:
        return False
    (name,), cause = hidden_in(result), result["causes"][0]
    inseparable = result["verdict"] == "SET" and len(reported_set(cause)) <= LARGEST_SET and name in reported_set(cause)
    return cause["effect"] == name or inseparable


def named_alone(result: Result) -> bool:
    """Return whether exactly the hidden effects were named, with the verdict NAMED."""
    return result["verdict"] == "NAMED" and named_exactly(result)


def resolved_by_manoeuvre(result: Result) -> bool:
    """Return whether the hidden effect alone is certain after the proposed manoeuvre."""
    return named_alone(result["after"])


def misnamed(result: Result) -> bool:
    """Return whether another effect was named with certainty."""
    return result["verdict"] == "NAMED" and not named_first(result)


def named_exactly(result: Result) -> bool:
    """Return whether exactly the hidden effects were named."""
    return set(result["named"]) == set(hidden_in(result))


def named_all(result: Result) -> bool:
    """Return whether all hidden effects were named."""
    return set(result["named"]) >= set(hidden_in(result))


def interval_hits(result: Result) -> list[bool]:
    """Return, per parameter of a named hidden effect, whether its interval holds the truth."""
    named = [one for one in result.get("hidden", ()) if "theta" in one]
    rows = [zip(one["strengths"], one["theta"], one["half_width"], strict=True) for one in named]
    return [abs(true - theta) <= half for row in rows for true, theta, half in row]


def removed_shares(results: list[Result]) -> list[float]:
    """Return the skills over the true car's, where an effect was named and the true car's skill is significant."""
    counted = [r for r in results if r["named"] and "oracle" in r and r["oracle"][1] > 0]
    return [r["skill"]["extended"][0] / r["oracle"][0] for r in counted]


def imitates_truth(result: Result) -> bool:
    """Return whether the effects named for a missing one fit as well as the truth, within one parameter."""
    return result["verdict"] == "NAMED" and result["prices"]["named"] <= result["prices"]["truth"] + PARAMETER_PENALTY


def names_driving_variable(result: Result) -> bool:
    """Return whether the diagnosis reports a variable that drives the missing effect, among its first two.

    They are those of what remains, or of all errors of the nominal car where nothing does.
    """
    reported = result["unexplained"]["drivers"] or result["unexplained"]["at_first"]
    return any(variable in DRIVING_VARIABLES[name] for name in hidden_in(result) for variable in reported)


def height_within_tolerance(result: Result) -> bool:
    """Return whether the height of load transfer is within 15 % of the file's, or in a reported set."""
    for cause in result["causes"]:
        if cause["effect"] == "load_transfer_long":
            return abs(cause["theta"][0] * cause["scale"][0] / result["height"] - 1) < 0.15
        if "load_transfer_long" in reported_set(cause):
            return True
    return False


def named_any(result: Result) -> bool:
    """Return whether anything was named."""
    return bool(result["named"])


def worse_than_nominal(result: Result) -> bool:
    """Return whether the extended car predicts held-out runs worse than the nominal car."""
    return "extended" in result["skill"] and result["skill"]["extended"][0] < 0


def calibration_error(results: list[Result]) -> float:
    """Return the expected calibration error of the probabilities, over bins."""
    pairs = np.array([(c["probability"], c["effect"] in hidden_in(r)) for r in results for c in r["causes"]], float)
    if not len(pairs):
        return float("nan")
    bins = np.minimum((pairs[:, 0] * BINS).astype(int), BINS - 1)
    gaps = [len(p) * abs(p[:, 0].mean() - p[:, 1].mean()) for k in range(BINS) if len(p := pairs[bins == k])]
    return float(sum(gaps) / len(pairs))


def uniformity_p_value(none: list[Result]) -> float:
    """Return the p-value of uniform p-values of logs without effects (Kolmogorov and Smirnov)."""
    return float(kstest([r["p_first"] for r in none], "uniform").pvalue) if none else float("nan")


def confusions(results: list[Result]) -> list[str]:
    """Return one line per wrong case: group, truth, named effects, and the score of the truth."""
    wrong: list[str] = []
    tests: dict[str, Callable[[Result], bool]] = {
        "single": named_first,
        "pair": named_exactly,
        "poor": lambda r: not misnamed(r),
    }
    for r in results:
        condition = r["case"]["condition"]
        if "error" in r:
            wrong.append(f"{r['case']['condition']:7} FAILED {r['error'].strip().splitlines()[-1]}")
            continue
        ok = tests.get(condition, lambda r: r["verdict"] != "NAMED" or r["case"]["condition"] == "foreign")
        if not ok(r):
            wrong.append(_confusion(r))
    return sorted(wrong)


def _confusion(r: Result) -> str:
    truth = ", ".join(f"{h['name']} {h['strengths']}" for h in r["case"]["effects"]) or "nothing"
    named = ", ".join(f"{c['effect']} {np.round(c['theta'], 2)} P {c['probability']:.2f}" for c in r["causes"])
    looks = "; ".join(
        f"{h['effect']} T {h['T']:.1f}, rank {h['rank']}, like "
        + " ".join(f"{n} {c:.3f}" for n, c in h["alike"].items())
        for h in r.get("hidden", ())
    )
    cost = "".join(f", price {k} {v:.1f}" for k, v in r.get("prices", {}).items())
    return f"{r['group']}: {truth} -> {r['verdict']} {named or '-'} (p left {r.get('p_left', 1):.3f}; {looks}{cost})"
