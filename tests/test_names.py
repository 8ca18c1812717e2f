"""A public function, class or type of the package has one meaning: no other one has its name."""

import ast
import re
from collections import defaultdict
from pathlib import Path

CAMEL_CASE = re.compile("[A-Z][A-Za-z0-9]*[a-z][A-Za-z0-9]*")  # a type, not a constant or a type variable
PACKAGE = Path(__file__).resolve().parent.parent / "driftjax"
# Names that several modules define for one purpose, so that a caller can pick the module: verbs of the command line,
# stations of effects, parts of the bench, files of a study, readings of the same sensors,
# readers that run in a process of their own.
SHARED = {"run", "work", "defaults", "next_step", "main", "apply", "start", "measure_rows", "write_figures",
          "write_results", "sensor_reading", "read_arrays"}  # fmt: skip


def is_union(value: ast.expr | None) -> bool:
    """Return whether an expression is a union of names, such as `A | B` or `A | None`."""
    if not (isinstance(value, ast.BinOp) and isinstance(value.op, ast.BitOr)):
        return False
    sides = (value.left, value.right)
    return all(is_union(side) or isinstance(side, ast.Name | ast.Attribute | ast.Subscript) or
               (isinstance(side, ast.Constant) and side.value is None) for side in sides)  # fmt: skip


def defined(node: ast.stmt) -> str | None:
    """Return the name of the function, class or type alias that a statement defines; None for any other statement."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return node.name
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        marked = ast.unparse(node.annotation).endswith("TypeAlias")
        return node.target.id if marked or CAMEL_CASE.fullmatch(node.target.id) else None
    if isinstance(node, ast.Assign) and len(node.targets) == 1 and isinstance(node.targets[0], ast.Name):
        name = node.targets[0].id
        return name if CAMEL_CASE.fullmatch(name) or (name[0].isupper() and is_union(node.value)) else None
    return None


def repeated(sources: dict[str, str]) -> dict[str, list[str]]:
    """Public functions, classes and type aliases of these modules that more than one of them defines."""
    places = defaultdict(list)
    for path, source in sources.items():
        for name in filter(None, map(defined, ast.parse(source).body)):
            if not name.startswith("_"):
                places[name].append(path)
    return {name: paths for name, paths in places.items() if len(paths) > 1}


def test_a_public_name_has_one_meaning():
    sources = {str(path.relative_to(PACKAGE)): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    names = repeated(sources)
    assert {name: paths for name, paths in names.items() if name not in SHARED} == {}
    assert SHARED <= set(names), "no longer shared"


def test_a_second_definition_is_noticed():
    one, other = "def fit(): ...\nclass _Own: ...", "class fit: ...\nclass _Own: ...\ndef run(): ..."
    assert repeated({"a.py": one, "b.py": other}) == {"fit": ["a.py", "b.py"]}


def test_a_second_meaning_of_a_type_is_noticed():
    one = "Car = int | None\nReport: TypeAlias = dict\nT = TypeVar('T')\nLIMIT = 1 | 2\nflags = a | b\nX = A | B"
    other = "class Car: ...\nReport = Callable[[str], None]\nT = TypeVar('T')\nLIMIT = 2\nflags = a | c\n_X = A | B"
    assert repeated({"a.py": one, "b.py": other}) == {"Car": ["a.py", "b.py"], "Report": ["a.py", "b.py"]}
