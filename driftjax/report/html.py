"""Build a self-contained HTML page: nothing is loaded from elsewhere."""

import base64
import html
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

CSS = """body{font:16px/1.5 system-ui,sans-serif;max-width:1000px;margin:2rem auto;padding:0 1rem;color:#222}
pre{background:#f6f6f6;padding:1rem;overflow-x:auto;font-size:13px}img{max-width:100%}h2{margin-top:2.5rem}"""


def document(title: str, created: str, parts: Iterable[str]) -> str:
    """Return the page."""
    head = f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{html.escape(title)}</title>"
    head += f"<style>{CSS}</style>\n<h1>{html.escape(title)}</h1><p>{html.escape(created)}</p>"
    return "\n".join([head, *parts]) + "</html>\n"


def heading(words: str) -> str:
    """Return the heading of a section."""
    return f"<h2>{html.escape(words)}</h2>"


def paragraph(words: str, strong: bool = False) -> str:
    """Return a paragraph."""
    return f"<p><strong>{html.escape(words)}</strong></p>" if strong else f"<p>{html.escape(words)}</p>"


def preformatted(words: str) -> str:
    """Return preformatted text, such as a table."""
    return f"<pre>{html.escape(words)}</pre>"


def image(path: Path, title: str, words: str = "") -> str:
    """Return the PNG at `path` under its title, with the caption `words`."""
    data, name = base64.b64encode(path.read_bytes()).decode(), html.escape(title, quote=True)
    image = f"<img alt='{name}' src='data:image/png;base64,{data}'>"
    return heading(title) + image + (paragraph(words) if words else "")


def collapsible(title: str, content: Any) -> str:
    """Return `content` as YAML in a section that opens on a click."""
    words = html.escape(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
    return f"{heading(title)}<details><summary>show</summary><pre>{words}</pre></details>"
