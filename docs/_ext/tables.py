"""Markdown tables."""

import re

MEASURED = re.compile(r"[<>=]*\s*-?[\d./]+( [a-zA-Z%/^2]+)?( \[[^\]]*\]( \(\d+\))?)?")  # with unit, interval, cases


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a Markdown table; a number stays on one line with unit, interval and number of cases."""
    whole = lambda cell: cell.replace(" ", "\u00a0") if MEASURED.fullmatch(cell) else cell
    lines = [head, tuple("---" for _ in head), *(map(whole, row) for row in rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in lines) + "\n"
