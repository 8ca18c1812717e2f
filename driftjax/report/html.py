"""Build a self-contained HTML page: nothing is loaded from elsewhere, and all that comes from a run is escaped."""

import base64
import hashlib
import html
import json
import math
import re
from collections.abc import Iterable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from driftjax.store.files import to_json_types

ASSETS = resources.files("driftjax.report") / "page"
STYLES = ("page.css",)
SCRIPTS = (
    "data.js",
    "chart.js",
    "curves.js",
    "map.js",
    "player.js",
    "tables.js",
    "learn.js",
    "diagnosis.js",
    "main.js",
)
LEVELS = 65534  # of a packed number; the one above means missing


class Cell(NamedTuple):
    """One cell of a table."""

    text: str
    source: str = ""  # file and key that the number comes from
    value: float | None = None  # what the column is sorted by; left out: the text


def quantity(text: str, source: str) -> Cell:
    """Return a cell from `source`, sorted by the number at the start of its text, if there is one."""
    number = re.match(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?(?![\w.])", text)
    return Cell(text, source, float(number[0]) if number else None)


def quantities(rows: Iterable[Sequence[str]], source: str) -> list[list[Cell]]:
    """Return the cells of `rows`, which all come from `source`."""
    return [[quantity(text, source) for text in row] for row in rows]


def document(title: str, created: str, parts: Iterable[str], data: dict[str, Any]) -> str:
    """Return the page; scripts read `data`. Its policy forbids every request, and every script but the page's own."""
    style, script = (_join(names) for names in (STYLES, SCRIPTS))
    policy = f"default-src 'none'; img-src data:; style-src {_hash(style)}; script-src {_hash(script)}"
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{html.escape(title)}</title>
<style>{style}</style></head>
<body><header><h1>{html.escape(title)}</h1><p class="source">{html.escape(created)}</p></header>
<main>
<noscript><p>Without JavaScript this page shows its tables and figures only.</p></noscript>
{chr(10).join(parts)}
</main>
<script type="application/json" id="data">{embedded_json(data)}</script>
<script>{script}</script>
</body></html>
"""


def _join(names: Iterable[str]) -> str:
    return "\n".join((ASSETS / name).read_text(encoding="utf-8") for name in names)


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def embedded_json(data: Any) -> str:
    """Return strict JSON that cannot end the script element that holds it, whatever the names in it."""
    text = json.dumps(to_json_types(data), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def pack(values: np.ndarray) -> dict[str, Any]:
    """Return numbers as base64 of little-endian 16-bit steps of `step` above `low`; 65535 is missing.

    The error is at most half a step, 1/131068 of the range.
    """
    values = np.asarray(values, float)
    finite = np.isfinite(values)
    low, high = (float(f(values[finite])) if finite.any() else 0.0 for f in (np.min, np.max))
    step = (high - low) / LEVELS or 1.0
    steps = np.where(finite, np.round((np.where(finite, values, low) - low) / step), LEVELS + 1)
    return {"low": low, "step": step, "b": base64.b64encode(steps.astype("<u2").tobytes()).decode()}


def section(title: str, parts: Iterable[str], name: str = "") -> str:
    """Return a section under its heading; scripts find it by `name`."""
    return f"<section{_attribute('id', name)}><h2>{html.escape(title)}</h2>\n{chr(10).join(parts)}</section>"


def html_heading(words: str) -> str:
    """Return the heading of a part of a section."""
    return f"<h3>{html.escape(words)}</h3>"


def stage_for(name: str, label: str) -> str:
    """Return the empty element `name` that a script fills with what `label` says."""
    return f"<div{_attribute('id', name)} role='group'{_attribute('aria-label', label)}></div>"


def paragraph(words: str, kind: str = "") -> str:
    """Return a paragraph; `kind` is its class: lead, source, or none."""
    return f"<p{_attribute('class', kind)}>{html.escape(words)}</p>"


def _attribute(name: str, value: str) -> str:
    return f' {name}="{html.escape(value, quote=True)}"' if value else ""


def table(head: Sequence[str], rows: Iterable[Sequence[Cell | str]], caption: str) -> str:
    """Return a table that scripts make sortable; `caption` says what it shows and which file it comes from."""
    cells = [[cell if isinstance(cell, Cell) else Cell(cell) for cell in row] for row in rows]
    top = "".join(f'<th scope="col">{html.escape(words)}</th>' for words in head)
    body = "\n".join(f"<tr>{''.join(map(_td, row))}</tr>" for row in cells)
    return (
        f'<div class="wide" tabindex="0" role="region"{_attribute("aria-label", caption)}><table>'
        f"<caption>{html.escape(caption)}</caption><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _td(cell: Cell) -> str:
    finite = cell.value is not None and math.isfinite(cell.value)
    value = _attribute("data-value", repr(float(cell.value or 0.0)) if finite else "")
    return f"<td{_attribute('title', cell.source)}{value}>{html.escape(cell.text)}</td>"


def image(path: Path, title: str, words: str = "") -> str:
    """Return the PNG at `path` under its title, with the caption `words`."""
    data, name = base64.b64encode(path.read_bytes()).decode(), html.escape(title, quote=True)
    caption = f"{words} Source: figures/{path.name}; as PDF beside it.".strip()
    return (
        f'<figure><h3>{html.escape(title)}</h3><img alt="{name}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def figures(images: list[str]) -> list[str]:
    """Return the section of figures, closed at first; none without images."""
    return (
        [section("Figures", ["<details><summary>Show all figures</summary>", *images, "</details>"])] if images else []
    )


def collapsible(title: str, content: Any) -> str:
    """Return `content` as YAML in an element that opens on a click."""
    words = html.escape(yaml.safe_dump(to_json_types(content), sort_keys=False, allow_unicode=True))
    return f"<details><summary>{html.escape(title)}</summary><pre>{words}</pre></details>"
