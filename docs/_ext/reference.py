"""Sphinx extension: write the generated part of the reference, and formulas as MathML, which need no script."""

import re
from pathlib import Path

from api import api_page
from catalogue import effects_page, variables_page
from docutils import nodes
from docutils.utils.math import latex2mathml
from options import command_pages, configuration_page
from results import learn_tables, real_log_tables, recorded_tables, statistics_table
from sphinx.application import Sphinx

BAR = re.compile(r"<mo[^>]*>([|‖])</mo>")


def write_pages(app: Sphinx) -> None:
    """Write all generated pages; a page that has not changed keeps its time, so that it is not read again."""
    folder = Path(app.srcdir) / "generated"
    folder.mkdir(exist_ok=True)
    pages = {f"driftjax-{verb}": text for verb, text in command_pages().items()}
    pages |= {"api": api_page(), "configuration": configuration_page(), "effects": effects_page()}
    pages |= {"variables": variables_page(), "learn": learn_tables(Path(app.srcdir)),
              "real-logs": real_log_tables(Path(app.srcdir)),
              "hidden-effects-statistics": statistics_table(Path(app.srcdir)),
              **recorded_tables(Path(app.srcdir))}  # fmt: skip
    for old in folder.glob("*.md"):
        if old.stem not in pages:
            old.unlink()
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _math(self, node) -> None:
    """Write a formula as MathML."""
    block = node.tagname == "math_block"
    markup = latex2mathml.tex2mathml(node.astext(), as_block=block)
    markup = markup.replace('<mover accent="true">', "<mover>")  # as accents, Chromium draws dots into the letter
    markup = BAR.sub(r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>', markup)  # the left one alone would stretch
    self.body.append(f'<div class="formula">{markup}</div>' if block else markup)
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hooks."""
    app.add_html_math_renderer("mathml", (_math, None), (_math, None))
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True}
