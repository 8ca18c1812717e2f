"""A public function or class of the package has one meaning: no other one has its name."""

import ast
from collections import defaultdict
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "driftjax"
# Names that several modules define for one purpose, so that a caller can pick the module: verbs of the command line,
# stations of effects, parts of the bench, files of a study, readings of the same sensors.
SHARED = {"run", "work", "defaults", "next_step", "main", "apply", "start", "measure_rows", "write_figures",
          "write_results", "sensor_reading"}  # fmt: skip


def repeated(sources: dict[str, str]) -> dict[str, list[str]]:
    """Public functions and classes of these modules that more than one of them defines."""
    places = defaultdict(list)
    for path, source in sources.items():
        for node in ast.parse(source).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(path)
    return {name: paths for name, paths in places.items() if len(paths) > 1}


def test_a_public_name_has_one_meaning():
    sources = {str(path.relative_to(PACKAGE)): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    names = repeated(sources)
    assert {name: paths for name, paths in names.items() if name not in SHARED} == {}
    assert SHARED <= set(names), "no longer shared"


def test_a_second_definition_is_noticed():
    one, other = "def fit(): ...\nclass _Own: ...", "class fit: ...\nclass _Own: ...\ndef run(): ..."
    assert repeated({"a.py": one, "b.py": other}) == {"fit": ["a.py", "b.py"]}
