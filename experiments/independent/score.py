"""Score diagnoses against the truth: effects, families, false names, intervals. Works on plain values only."""

from collections.abc import Callable
from typing import Any

import numpy as np

import driftjax as dj

LARGEST_SET = 3  # effects that a reported set may hold to count as an answer
OTHERWISE_DEFINED = ("power_limit", "side_wind")  # whose parameters the plant defines otherwise than the catalogue
OF_SENSORS = ("sensor", "time base")
BODY = ("track_width",)  # what `body` brings along: not looked for, and not false where it is named
Result = dict[str, Any]


def family_of(name: str) -> str:
    """Return the part of the car or of the measurement that the effect `name` belongs to."""
    (effect,) = dj.effects_by_name((name,))
    return effect.family


def effects_of_body(body: float) -> tuple[str, ...]:
    """Return the effects that `body` brings along."""
    return BODY if body else ()


def reported_set(cause: dict[str, Any]) -> list[str]:
    """Return a named effect with its rivals."""
    return [cause["effect"], *cause["rivals"]]


def match(causes: list[dict[str, Any]], hidden: list[str]) -> dict[str, str]:
    """Return named effect -> hidden effect: itself, or one not yet found in its set of at most `LARGEST_SET`."""
    matches = {cause["effect"]: cause["effect"] for cause in causes if cause["effect"] in hidden}
    for cause in causes:
        members = reported_set(cause)
        free = [name for name in members if name in hidden and name not in matches.values()]
        if cause["effect"] not in matches and len(members) <= LARGEST_SET and free:
            matches[cause["effect"]] = free[0]
    return matches


def score(result: Result) -> Result:
    """Return what is right in one result."""
    truth, causes = result["case"]["hidden"], result["causes"]
    hidden, named = list(truth), [cause["effect"] for cause in causes]
    matches = match(causes, hidden)
    families = {family_of(name) for name in [*named, *matches.values()]}
    wanted = {family_of(name) for name in hidden}
    tentative = {cause["effect"] for cause in causes if cause.get("exploratory")}
    there = effects_of_body(result["case"]["body"])
    wrong = [name for name in named if name not in matches and name not in there]
    false = [name for name in wrong if name not in tentative]
    physics = [name for name in named if family_of(name) not in OF_SENSORS and name not in there]
    return {
        "first": bool(causes) and causes[0]["effect"] in matches,
        "found": sorted(matches.values()),
        "missed": sorted(set(hidden) - set(matches.values())),
        "false": false,
        "exploratory": sorted(tentative),
        "false_exploratory": [name for name in wrong if name in tentative],
        "families_found": sorted(wanted & families),
        "families_missed": sorted(wanted - families),
        "families_false": sorted({family_of(name) for name in false} - wanted),
        "physics": [name for name in physics if name not in tentative],
        "physics_exploratory": [name for name in physics if name in tentative],
        "covered": coverage(causes, truth),
    }


def coverage(causes: list[dict[str, Any]], truth: dict[str, dict[str, float]]) -> dict[str, bool]:
    """Return per parameter of an effect rightly named whether its 95 % interval holds the truth."""
    held = {}
    for cause in causes:
        if cause["effect"] in truth and cause["effect"] not in OTHERWISE_DEFINED:
            for name, value in truth[cause["effect"]].items():
                low, high = cause["parameters"][name]["ci95"]
                held[f"{cause['effect']}.{name}"] = bool(low <= value <= high)
    return held


def right_verdict(result: Result) -> bool:
    """Return whether the verdict is NOTHING where nothing is hidden, else NAMED or SET."""
    return result["verdict"] in (("NAMED", "SET") if result["case"]["hidden"] else ("NOTHING",))


GROUPS: dict[str, Callable[[int], bool]] = {
    "nothing": lambda n: n == 0, "one": lambda n: n == 1, "two": lambda n: n == 2,
    "three or four": lambda n: n in (3, 4), "five or six": lambda n: n > 4, "one to four": lambda n: 1 <= n <= 4,
}  # fmt: skip
HEAD = (
    "hidden", "car", "cases", "first", "effects found", "all found", "families found", "all families", "no false name",
    "no false family", "false exploratory", "right verdict", "UNKNOWN", "in 95 % interval", "explained", "s",
)  # fmt: skip


def group_row(results: list[Result]) -> list[str]:
    """Return one row of the table: shares over these results."""
    each = [score(one) for one in results]
    share = lambda values: f"{sum(values)}/{len(values)}" if len(values) else "-"
    effects = [name in s["found"] for s in each for name in (*s["found"], *s["missed"])]
    families = [name in s["families_found"] for s in each for name in (*s["families_found"], *s["families_missed"])]
    with_truth = [s for s, one in zip(each, results, strict=True) if one["case"]["hidden"]]
    explained = [one["explained"]["share"] for one in results if one["explained"]]
    explained = [value for value in explained if value is not None and np.isfinite(value)]
    return [
        str(len(results)), share([s["first"] for s in with_truth]), share(effects),
        share([not s["missed"] for s in with_truth]), share(families),
        share([not s["families_missed"] for s in with_truth]), share([not s["false"] for s in each]),
        share([not s["families_false"] for s in each]),
        share([name in s["false_exploratory"] for s in each for name in s["exploratory"]]),
        share([right_verdict(one) for one in results]),
        share([one["verdict"] == "UNKNOWN" for one in results]),
        share([held for s in each for held in s["covered"].values()]),
        f"{np.median(explained):.2f}" if explained else "-", f"{np.median([one['seconds'] for one in results]):.0f}",
    ]  # fmt: skip


def table(results: list[Result]) -> str:
    """Return the scores as a Markdown table, by number of hidden effects and car; failed cases are counted below.

    False names and families are those of causes that are not exploratory; of these the false ones have a column.
    """
    done = [one for one in results if "error" not in one]
    lines = ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
    for group, belongs in GROUPS.items():
        for cars in (("sedan",), ("rc",), ("sedan", "rc")):
            rows = [one for one in done if one["case"]["car"] in cars and belongs(len(one["case"]["hidden"]))]
            if rows:
                lines.append("| " + " | ".join([group, " and ".join(cars), *group_row(rows)]) + " |")
    return "\n".join([*lines, "", f"{len(results) - len(done)} of {len(results)} cases failed."])


def alarm_table(results: list[Result]) -> str:
    """Return how often physics is named where only the sensors err, and how often the sensors' errors are."""
    done = [one for one in results if "error" not in one]
    each = [score(one) for one in done]
    physics = sum(bool(s["physics"]) for s in each)
    hidden = sum(len(one["case"]["hidden"]) for one in done)
    num_found, false = sum(len(s["found"]) for s in each), sum(bool(s["false"]) for s in each)
    tentative = sum(bool(s["physics_exploratory"]) for s in each)
    return (f"Of {len(done)} logs in which only sensors err {physics} name physics, {tentative} as exploratory, "
            f"and {false} anything false; {num_found} of {hidden} errors of sensors were found; "
            f"{len(results) - len(done)} cases failed.")  # fmt: skip


def line(result: Result) -> str:
    """Return one result in a line: truth -> verdict, causes, what is missed and false."""
    case = result["case"]
    head = f"{case['number']} {case['car']} {10 * len(case['manoeuvres'])} s body {case['body']:g}: "
    head += " + ".join(case["hidden"]) or "nothing"
    if "error" in result:
        return f"{head} -> failed: {result['error'].strip().splitlines()[-1]}"
    s = score(result)
    named = ", ".join(f"{c['effect']} {c['probability']:.2f}" for c in result["causes"]) or "-"
    wrong = "".join(f"; {what}: {', '.join(s[what])}" for what in ("missed", "false", "false_exploratory") if s[what])
    return f"{head} -> {result['verdict']} {named}{wrong}; {result['seconds']:.0f} s"
