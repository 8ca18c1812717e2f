"""Imports point downwards only, and never sideways within a row."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "driftjax"
ROWS = (
    "core | parallel | tyre gp solve track data | vehicle | sim equilibrium | control plan | explore | learn diagnose"
    " | tune | report | sweep | cli"
)
RANK = {name: rank for rank, row in enumerate(ROWS.split("|")) for name in row.split()}
FILES = sorted(PACKAGE.rglob("*.py"))


def folder_of(path: Path) -> str:
    """Folder below driftjax/, or the module's own name for a file directly in it."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[0]


def imported(tree: ast.AST) -> list[tuple[int, str]]:
    """(line, dotted name) of everything imported from this repository."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            module = node.module or ""
            found += [
                (node.lineno, f"{module}.{alias.name}" if module == "driftjax" else module) for alias in node.names
            ]
    return [(line, name) for line, name in found if name.split(".")[0] in ("driftjax", "experiments", "tests")]


def offences(path: Path, source: str) -> list[str]:
    """Imports in the file `path` with text `source` that point up or sideways."""
    me, bad = folder_of(path), []
    if me == "__init__":
        return [f"{line}: {name}" for line, name in imported(ast.parse(source))]
    for line, name in imported(ast.parse(source)):
        root, *rest = name.split(".")
        if root != "driftjax":
            allowed = root == "experiments" and me == "cli"
        elif not rest or rest[0].startswith("__") or rest[0].isupper():
            allowed = True  # the version and constants of the package itself
        else:
            allowed = rest[0] == me or RANK[rest[0]] < RANK[me]
        if not allowed:
            bad.append(f"{path.name}, line {line}: {me} imports {name}")
    return bad


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_downwards(path):
    assert folder_of(path) in RANK or path.name == "__init__.py", f"{path} is in no row"
    assert offences(path, path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("folder", "source"),
    [
        ("core", "from driftjax.vehicle import State"),
        ("plan", "from driftjax.control.mpc import MPCConfig"),
        ("vehicle", "import driftjax.sim"),
        ("tyre", "from driftjax import gp"),
        ("learn", "def f():\n    from driftjax.report import table"),
        ("sim", "import driftjax.equilibrium.map"),
    ],
)
def test_the_rule_catches_imports_that_point_up_or_sideways(folder, source):
    assert len(offences(PACKAGE / folder / "module.py", source)) == 1


def test_modules_are_short():
    assert [path.name for path in FILES if len(path.read_text(encoding="utf-8").splitlines()) > 400] == []
