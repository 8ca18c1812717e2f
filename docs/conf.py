"""Sphinx configuration; `uv run --group docs sphinx-build -W --keep-going docs docs/_build/html` builds the site."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

import driftjax  # noqa: E402

project, author, release = "driftjax", "the driftjax developers", driftjax.__version__
copyright = author
extensions = ["myst_nb", "reference"]
exclude_patterns = ["_build", "_ext", "generated/api.md", "generated/configuration.md", "generated/effects.md",
                    "generated/variables.md", "generated/learn.md", "generated/real-logs.md",
                    "generated/hidden-effects-statistics.md", "generated/table-*.md"]  # fmt: skip
suppress_warnings = ["config.cache"]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "attrs_inline"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # examples are run by the tests

nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!driftjax\.).*")]  # what is not ours has no page here
python_maximum_signature_line_length = 80
toc_object_entries = False
add_module_names = False

html_theme = "sphinx_book_theme"
html_title = "driftjax"
html_context = {"default_mode": "auto"}  # dark or light as the reader's system is
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"show_navbar_depth": 1, "show_toc_level": 2, "use_download_button": False,
                      "use_fullscreen_button": False, "navbar_start": [], "navbar_center": [],
                      "navbar_end": [], "navbar_persistent": []}  # fmt: skip
html_show_sphinx = False
smartquotes = False  # would turn --flag into a dash
highlight_language = "none"
html_copy_source = False
