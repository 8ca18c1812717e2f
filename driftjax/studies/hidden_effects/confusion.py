"""List the cases that went wrong, each in one line with what was named and how the truth scored."""

from collections.abc import Callable

import numpy as np

from driftjax.studies.hidden_effects.criteria import Result, misnamed, named_exactly, named_first


def confusions(results: list[Result]) -> list[str]:
    """Return one line per wrong case: group, truth, what was named, and how the truth scored."""
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
