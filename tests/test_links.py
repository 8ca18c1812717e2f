"""Every relative link of the Markdown files leads to a file, and to a heading of it where it names one."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(path for path in ROOT.glob("docs/**/*.md") if "_build" not in path.parts)])
PAGES = [path for path in PAGES if "generated" not in path.parts]  # Sphinx writes these, and checks links to them
FENCES = re.compile(r"^ *(```|:::).*?^ *\1", re.MULTILINE | re.DOTALL)  # code, and directives, which Sphinx checks


def anchors(path: Path) -> set[str]:
    """Names of the headings of a page as GitHub and MyST make them."""
    headings = re.findall(r"^#+ +(.+)$", FENCES.sub("", path.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken(path: Path, text: str) -> list[str]:
    """Relative links of a page's text that lead nowhere."""
    lost = []
    for link in re.findall(r"\]\(\s*([^)\s]+)", re.sub(r"`[^`\n]*`", "", FENCES.sub("", text))):
        if re.match(r"[a-z]+:", link) or "generated/" in link:
            continue
        name, _, anchor = link.partition("#")
        to = (path.parent / name).resolve() if name else path
        if not to.exists() or (anchor and anchor not in anchors(to)):
            lost.append(link)
    return lost


def test_links_resolve():
    broken_links = {path.name: broken(path, path.read_text(encoding="utf-8")) for path in PAGES}
    assert {name: links for name, links in broken_links.items() if links} == {}


def test_a_link_to_nowhere_is_noticed():
    links = (
        "[a](CHANGELOG.md) [b](NONE.md) [c](docs/getting-started.md#learn-to-drift) [d](docs/index.md#none) `[e](f)`"
    )
    assert broken(ROOT / "README.md", links) == ["NONE.md", "docs/index.md#none"]
