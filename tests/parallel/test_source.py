"""The source a function depends on: its module and what that imports, however it is written, and no more."""

import ast
import sys

import pytest

from driftjax.parallel import source
from driftjax.parallel.source import source_files, source_hash


def test_the_laps_depend_on_the_car_and_not_on_reports():
    rooms = {name.split(".")[1] for name in source_files("driftjax.learning.stage") if "." in name}
    assert {"core", "parallel", "vehicle", "control", "solve", "gp"} <= rooms
    assert not rooms & {"report", "sweep", "cli", "diagnose", "tune"}


def test_the_universal_car_depends_on_every_effect_though_none_is_imported_by_name():
    effects = {f"driftjax.vehicle.effect.{name}" for name in ("aero_drag", "linear", "traction_limit")}
    assert effects <= set(source_files("driftjax.vehicle.universal"))


def test_the_verbs_of_a_sweep_depend_on_the_experiments_that_they_run():
    assert "driftjax.studies.paper.run" in source_files(
        "driftjax.studies.sweepable_verbs"
    )  # imported inside a function


def test_imports_are_those_that_python_parses():
    for name, file in source_files("driftjax.studies.sweepable_verbs").items():
        listed = "iter_modules(__path__)" in file.read_text()  # a package that imports all its modules
        wanted = {f"{name}.{one.stem}" for one in file.parent.glob("[!_]*.py")} if listed else set()
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.Import):
                wanted |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                wanted |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        known = lambda names: {one for one in names if source._file(one)}
        assert known(source._imports(name, file)) == known(wanted), name


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package `p` of two levels, whose module p.q.a imports in every way."""
    inner = tmp_path / "p" / "q"
    inner.mkdir(parents=True)
    names = ("b", "c", "d", "e", "f", "unused")
    for file in (tmp_path / "p" / "__init__.py", inner / "__init__.py", *(inner / f"{name}.py" for name in names)):
        file.write_text("")
    (tmp_path / "p" / "above.py").write_text("import numpy")
    (inner / "a.py").write_text(
        '"""import p.q.nothing\nfrom ... import prose"""\n'
        "import os, p.q.b as one\nfrom p.q import (  # some\n    c as two,\n    missing,\n)\nfrom . import d\n"
        "from .e import f\nfrom ..above import g\ndef later():\n    from p.q.f import h\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    for cached in (source_hash, source._closure, source._imports, source._file):
        cached.cache_clear()
    return tmp_path


def test_every_way_to_import_is_followed(package):
    names = {name for name in source_files("p.q.a") if name.startswith("p")}
    assert names == {"p", "p.q", "p.q.a", "p.q.b", "p.q.c", "p.q.d", "p.q.e", "p.q.f", "p.above"}
    assert not [name for name in sys.modules if name.startswith("p.q")]  # nothing was imported


def test_libraries_count_by_their_version(package, monkeypatch):
    first = source_hash("p.q.a")
    monkeypatch.setattr(source, "_version", lambda library: f"{library} 99")
    source_hash.cache_clear()
    assert source_hash("p.q.a") != first
    assert not [name for name in source_files("p.q.a") if name.startswith(("numpy", "os"))]


def test_a_module_without_a_file_has_no_hash():
    with pytest.raises(LookupError, match="no_such_module"):
        source_hash("no_such_module")
