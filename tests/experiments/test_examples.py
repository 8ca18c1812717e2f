"""The examples run as they stand, are short, and show every function of the public interface."""

import ast
import runpy
from pathlib import Path

import pytest
from diagnosis.recorded import EFFECTS

import driftjax as dj

EXAMPLES = sorted((Path(__file__).parents[2] / "experiments" / "examples").glob("*.py"))
# run elsewhere, with what is asserted of them: tests/learning/test_loop.py, tests/diagnosis/test_compare.py
ELSEWHERE = ("learn.py", "compare.py")
LINES = 12  # of code, classes and functions among them: all but docstrings, imports, comments and blank lines


@pytest.mark.parametrize("path", [path for path in EXAMPLES if path.name not in ELSEWHERE], ids=lambda path: path.stem)
def test_an_example_runs_as_it_stands(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [str(path), str(tmp_path / "out.csv" if path.stem == "read_log" else tmp_path)])
    monkeypatch.setattr(dj, "setup", lambda cache: None)  # the cache of the tests stays
    # the small catalogue, whose programs other tests compile; the whole one runs with the wheel (-m slow)
    monkeypatch.setitem(dj.calibrate.__kwdefaults__, "catalogue", EFFECTS)
    monkeypatch.setitem(dj.diagnose.__kwdefaults__, "effects", EFFECTS)
    runpy.run_path(str(path), run_name="__main__")
    said = capsys.readouterr().out
    assert said and "nan" not in said.lower()


def lines_of_code(text: str) -> int:
    """Count the lines of a module but docstrings, imports, comments and blank lines."""
    left_out: list[ast.stmt] = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            left_out.append(node)
        elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            left_out.append(node.body[0])
    apart = {line for node in left_out for line in range(node.lineno, (node.end_lineno or 0) + 1)}
    lines = enumerate(text.splitlines(), start=1)
    return sum(bool(line.strip()) and not line.strip().startswith("#") and at not in apart for at, line in lines)


def test_lines_of_code_are_counted():
    lines = ['"""Say', 'more."""', "import a", "from b import (", "    c,", ")", "", "", "def f(x):", '    """Say."""',
             "    # why", "    return c(", "        x", "    )", "", ""]  # fmt: skip
    text = "\n".join(lines)
    assert lines_of_code(text) == 4


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short(path):
    assert 0 < lines_of_code(path.read_text(encoding="utf-8")) <= LINES


def test_the_examples_show_what_the_package_is_for():
    text = "".join(path.read_text(encoding="utf-8") for path in EXAMPLES)
    shown = ("setup", "load_vehicle", "load_plant", "draw_plants", "simulate", "load_track", "plan", "save_plan",
             "equilibria", "fit_gp", "fit_kernel", "DriftMPC", "learn", "read_log", "inspect", "calibrate", "diagnose",
             "compare")  # fmt: skip
    assert [name for name in shown if f"dj.{name}(" not in text] == []


def test_the_readme_is_short_and_its_code_is_that_of_the_examples():
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    shown = [
        line.split("  # ")[0]
        for block in readme.split("```python\n")[1:]
        for line in block.split("```")[0].splitlines()
    ]
    lines = {line for path in EXAMPLES for line in path.read_text(encoding="utf-8").splitlines()}
    assert len(readme.encode()) <= 6000 and len(shown) >= 4
    assert [line for line in shown if line not in lines] == []


def test_every_public_name_is_there_and_documented():
    for name in dj.__all__:
        assert getattr(dj, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'simulat'.*simulate"):
        dj.simulat  # noqa: B018
