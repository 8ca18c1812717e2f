"""Format the rows as Markdown, as printed and documented."""

from collections.abc import Mapping, Sequence
from typing import Any

from driftjax.report.table import markdown_table

UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (1e-9, "ns"))
HEAD = ("part", "what", "time", "against", "its time", "ratio", "target", "met", "remarks")
WORDS = {
    "solved": "solved to the tolerance {:.4g}",
    "solved_wide": "from starts three times as wide {:.4g}",
    "at_ipopts_wide": "of these {:.4g} at IPOPT's optimum or a better one",
    "cost_difference_fatrop": "optimal cost apart by at most {:.1e}",
    "cost_difference_ipopt": "optimal cost apart by at most {:.1e}",
    "difference": "states apart by at most {:.1e}",
}


def seconds(value: float) -> str:
    """Format a time with three digits and a suitable unit."""
    scale, unit = next(((scale, unit) for scale, unit in UNITS if value >= scale), UNITS[-1])
    return f"{value / scale:.3g} {unit}"


def _ratio(row: Mapping[str, Any]) -> str:
    ratio = row["ratio"]
    if ratio is None or row["sense"] == "seconds":
        return "-"
    low, high = ratio["quartiles"]
    return f"{ratio['median']:.3g} [{low:.3g}, {high:.3g}]"


def _target(row: Mapping[str, Any]) -> str:
    if row["target"] is None:
        return ""
    unit = " s" if row["sense"] == "seconds" else ""
    return f"{'>=' if row['sense'] == 'faster' else '<='} {row['target']:.4g}{unit}"


def _remarks(row: Mapping[str, Any]) -> str:
    facts = row["facts"]
    own = facts.get("remarks", "")
    other = "ipopt" if "IPOPT" in row["against"] else "fatrop"
    notes = [
        words.format(facts[name])
        for name, words in WORDS.items()
        if name in facts and not (name.startswith("cost_difference") and not name.endswith(other))
    ]
    return "; ".join([*notes, *([own] if own else [])])


def cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the columns of one row."""
    theirs, met = row["theirs"], row["met"]
    return (
        row["part"],
        row["what"],
        f"{seconds(row['ours']['median'])} per {row['unit']}",
        row["against"],
        row["missing"] or ("" if theirs is None else seconds(theirs["median"])),
        _ratio(row),
        _target(row),
        "" if met is None else ("yes" if met else "no"),
        _remarks(row),
    )


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format all rows of results.json as a Markdown table."""
    return "\n".join(markdown_table([HEAD, *map(cells, rows)]))


def conditions_line(machine: Mapping[str, Any], options: Mapping[str, Any]) -> str:
    """Return machine, date and options of the measurement in one line."""
    versions = machine["versions"]
    packages = ", ".join(f"{name} {versions[name]}" for name in ("jax", "casadi", "numba", "scikit-learn", "g++")
                         if versions.get(name))  # fmt: skip
    where = (versions["created"][:10], machine["processor"], f"{machine['cores']} cores", *machine["devices"])
    how = f"up to {options['repeats']} runs of each, medians; quartiles of the ratio in brackets."
    quick = " These are the tiny sizes of --quick, which say nothing about speed." if options["quick"] else ""
    return f"{', '.join(where)}; {packages}; {how}{quick}"


def bench_page(results: Mapping[str, Any]) -> str:
    """Return the content of results.md."""
    head = conditions_line(results["machine"], results["options"])
    return f"{head}\n\n{markdown(results['rows'])}\n"
