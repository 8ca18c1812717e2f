"""Imports point downwards only: never sideways within a row, never in a cycle; experiments use public functions."""

import ast
from pathlib import Path

import pytest

import driftjax

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "driftjax"
ROWS = (
    "environment | core | parallel | tyre gp track store logs | solve | vehicle | sim equilibrium | control planner"
    " | manoeuvres explore | learning diagnosis export | tune | report | sweep | studies | cli"
)
RANK = {name: rank for rank, row in enumerate(ROWS.split("|")) for name in row.split()}
FILES = sorted(PACKAGE.rglob("*.py"))
SCRIPTS = sorted((ROOT / "experiments").rglob("*.py"))


def folder_of(path: Path) -> str:
    """Folder below driftjax/, or the module's own name for a file directly in it."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imported(tree: ast.AST) -> list[tuple[int, str]]:
    """(line, dotted name) of everything imported from this repository."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            module = node.module or ""
            names += [
                (node.lineno, f"{module}.{alias.name}" if module == "driftjax" else module) for alias in node.names
            ]
    return [(line, name) for line, name in names if name.split(".")[0] in ("driftjax", "experiments", "tests")]


def offences(path: Path, source: str) -> list[str]:
    """Imports in the package's file `path` with text `source` that point up, sideways or out of the package."""
    me, bad = folder_of(path), []
    for line, name in imported(ast.parse(source)):
        root, *rest = name.split(".")
        if root != "driftjax":
            allowed = False
        elif me == "__init__":
            allowed = True  # the facade names what it exports
        elif not rest or rest[0].startswith("__"):
            allowed = True  # the version
        else:
            allowed = rest[0] == me or RANK[rest[0]] < RANK[me]
        if not allowed:
            bad.append(f"{path.name}, line {line}: {me} imports {name}")
    return bad


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_downwards(path):
    assert folder_of(path) in RANK or path.name == "__init__.py", f"{path} is in no row"
    assert offences(path, path.read_text(encoding="utf-8")) == []


def not_public(source: str) -> list[str]:
    """Return the imports of a script with text `source` beyond `import driftjax`, the studies and the solvers."""
    names = [name for _, name in imported(ast.parse(source))]
    public = [name for name in names if name == "driftjax" or name.removeprefix("driftjax.") in driftjax.__all__]
    public += [name for name in names if name.startswith(("driftjax.studies.", "experiments."))]
    public += [name for name in names if name == "driftjax.solve"]  # documented by itself: it knows no cars
    return sorted(set(names) - set(public))


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_experiments_use_public_functions_only(path):
    assert not_public(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "source",
    ["from driftjax.diagnosis.fit import evaluate_fit", "from driftjax.cli import main", "import driftjax.sim",
     "from tests.report import synthetic", "from driftjax.solve.batch import solve_batch"],
)  # fmt: skip
def test_the_rule_catches_imports_of_internals(source):
    assert len(not_public(source)) == 1


def test_the_rule_allows_the_facade_the_studies_and_the_solvers():
    lines = ["import driftjax as dj", "from driftjax import simulate", "from driftjax.studies.bench.run import x",
             "from driftjax.solve import solve"]  # fmt: skip
    assert not_public("\n".join(lines)) == []


@pytest.mark.parametrize(
    ("folder", "source"),
    [
        ("core", "from driftjax.vehicle import State"),
        ("planner", "from driftjax.control.mpc import MPCConfig"),
        ("vehicle", "import driftjax.sim"),
        ("tyre", "from driftjax import gp"),
        ("learning", "def f():\n    from driftjax.report import table"),
        ("sim", "import experiments.real_logs"),
        ("studies", "from driftjax.cli import main"),
        ("cli", "from experiments.real_logs import main"),
    ],
)
def test_the_rule_catches_imports_that_point_up_or_sideways(folder, source):
    assert len(offences(PACKAGE / folder / "module.py", source)) == 1


def test_modules_are_short():
    files = [*FILES, *SCRIPTS]
    assert [path.name for path in files if len(path.read_text(encoding="utf-8").splitlines()) > 400] == []


def test_functions_are_short():
    """At most 45 lines, with what is defined inside."""
    long = []
    for path in [*FILES, *SCRIPTS]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and (num := (node.end_lineno or 0) - node.lineno + 1) > 45:
                long.append(f"{path.relative_to(ROOT)}, {node.name}: {num} lines")
    assert long == []
