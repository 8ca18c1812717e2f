"""The notebooks are valid, hold no outputs, and their code is that of the examples, which are run."""

import ast
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))


class _WithoutArguments(ast.NodeTransformer):
    """Replace `sys.argv[1] if len(sys.argv) > 1 else FOLDER` by FOLDER: a notebook has no arguments."""

    def visit_IfExp(self, node: ast.IfExp) -> ast.expr:
        return node.orelse if "sys.argv" in ast.unparse(node.test) else node


def example(name: str) -> str:
    """Return the code of an example without docstring and arguments, in one form."""
    tree = ast.parse((ROOT / f"experiments/examples/{name}.py").read_text(encoding="utf-8"))
    tree.body = [node for node in tree.body[1:] if ast.unparse(node) != "import sys"]
    return ast.unparse(_WithoutArguments().visit(tree))


def test_there_is_a_notebook_of_each_use():
    assert [path.stem for path in NOTEBOOKS] == ["diagnose", "learn", "ocp"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_valid_without_outputs_and_has_the_code_of_its_example(path):
    book = nbformat.read(path, as_version=nbformat.NO_CONVERT)
    nbformat.validate(book)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in code)
    assert code[0].source.startswith("%pip install")
    assert ast.unparse(ast.parse("\n".join(cell.source for cell in code[1:]))) == example(path.stem)
