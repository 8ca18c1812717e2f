"""Wheel and sdist: the package alone with its files; what is in them runs outside the checkout."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from packaging.metadata import Metadata

ROOT = Path(__file__).resolve().parents[1]


def build(source: Path, out: Path, kind: str) -> Path:
    """Build the `kind` of archive from the folder `source`, offline."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(out)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return next(path for path in out.iterdir() if path.suffix == {"wheel": ".whl", "sdist": ".gz"}[kind])


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A copy of this checkout."""
    source = tmp_path_factory.mktemp("wheel") / "source"
    left_out = shutil.ignore_patterns("__pycache__", ".venv", ".git", "runs", "tests")
    shutil.copytree(ROOT, source, ignore=left_out)
    return source


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory) -> Path:
    """The wheel of this checkout."""
    return build(source, tmp_path_factory.mktemp("dist"), "wheel")


def test_the_wheel_holds_the_package_and_its_files_only(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"driftjax"}
    for name in ("py.typed", "configs/vehicle/sedan.yaml", "studies/bench/single_track.cpp", "report/page/player.js"):
        assert f"driftjax/{name}" in names, name


def test_the_metadata_of_the_wheel_are_valid_and_show_the_readme(wheel):
    archive = zipfile.ZipFile(wheel)
    content = archive.read(next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA")))
    metadata = Metadata.from_email(content, validate=True)
    assert metadata.description_content_type == "text/markdown" and metadata.license_files == ["LICENSE"]
    assert metadata.description == (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_sdist_holds_all_that_the_wheel_is_made_of(source, wheel, tmp_path):
    with tarfile.open(build(source, tmp_path / "dist", "sdist")) as archive:
        archive.extractall(tmp_path / "sdist", filter="data")
    (folder,) = (tmp_path / "sdist").iterdir()
    assert {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "PKG-INFO"} <= {
        path.name for path in folder.iterdir()
    }
    again = build(folder, tmp_path / "dist", "wheel")
    assert zipfile.ZipFile(again).namelist() == zipfile.ZipFile(wheel).namelist()
    Metadata.from_email((folder / "PKG-INFO").read_bytes(), validate=True)


def test_what_the_wheel_holds_runs_outside_the_checkout(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    (tmp_path / "empty").mkdir()
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site")}

    def run(*command: str) -> str:
        done = subprocess.run([sys.executable, *command], cwd=tmp_path / "empty", env=environment,
                              capture_output=True, text=True)  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert run("-c", "import driftjax; print(driftjax.__file__)").startswith(str(tmp_path / "site"))
    run("-c", "import driftjax as dj; assert all(getattr(dj, name).__doc__ for name in dj.__all__)")
    assert "nan" not in run(str(ROOT / "experiments" / "examples" / "simulate.py"))
    drive = ("simulate", "--manoeuvres", "slalom", "--duration", "4", "--out", "car")
    assert "log: car/log.csv" in run("-m", "driftjax.cli", *drive)
    assert "1 runs, 4.0 s" in run("-m", "driftjax.cli", "inspect", "car/log.csv")
    assert "DATA_INSUFFICIENT" in run("-m", "driftjax.cli", "diagnose", "car/log.csv")


def run_in(here: Path, *command: str | Path) -> str:
    """Run a command in the folder `here`, away from this environment, and return what it prints."""
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run([*map(str, command)], cwd=here, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ocp", "learn", "diagnose"])
def test_a_notebook_beside_the_wheel_runs_in_an_empty_environment(wheel, tmp_path, name):
    """As on Colab, its first cell installs the wheel. Needs a package registry."""
    python, book = tmp_path / "venv/bin/python", tmp_path / f"{name}.ipynb"
    shutil.copy(wheel, tmp_path)
    shutil.copy(ROOT / f"docs/notebooks/{name}.ipynb", book)
    run_in(tmp_path, "uv", "venv", "--seed", "--python", sys.executable, tmp_path / "venv")
    run_in(tmp_path, "uv", "pip", "install", "--python", python, "nbconvert", "ipykernel")
    command = ("--to", "notebook", "--execute", "--ExecutePreprocessor.timeout=-1", "--output", "done")
    run_in(tmp_path, python, "-m", "nbconvert", *command, book)
    cells = json.loads((tmp_path / "done.ipynb").read_text(encoding="utf-8"))["cells"]
    said = "".join(line for cell in cells[2:] for out in cell.get("outputs", ()) for line in out.get("text", ()))
    assert said and "nan" not in said.lower()


@pytest.mark.slow
def test_an_empty_environment_learns_diagnoses_and_runs_the_examples(wheel, tmp_path):
    """Needs a package registry: the run-time packages are installed again."""
    python, here = tmp_path / "venv/bin/python", tmp_path / "empty"
    here.mkdir()
    run = lambda *command: run_in(here, *command)
    run("uv", "venv", "--python", sys.executable, tmp_path / "venv")
    run("uv", "pip", "install", "--python", python, wheel)
    verb = tmp_path / "venv/bin/driftjax"
    run(verb, "learn", "--plants", "1", "--no-compare", "--gpr-laps", "1", "--explore.laps", "1", "--out", "learnt")
    run(verb, "simulate", "--effects", "yaw_inertia=2", "--out", "car")
    assert "NAMED" in run(verb, "diagnose", "car/log.csv", "--combined-slip", "1", "--out", "diagnosed")
    for example in sorted((ROOT / "experiments/examples").glob("*.py")):
        run(python, example)
