"""Pages for one kind of user: their commands run, and print what the pages show."""

import json
import re
from pathlib import Path

import pytest
import yaml
from drives import f1tenth_bag, vehicle_mat

from driftjax.cli import main

PAGES = Path(__file__).parents[2] / "docs/how-to"
RECORDINGS = {"f1tenth": ("my_bag", f1tenth_bag), "matlab": ("vehicle.mat", vehicle_mat), "race-stack": None}


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


def write_inputs(name: str, page: str) -> None:
    """A block of YAML that begins with the name of a file is that file."""
    for block in blocks(page, "yaml"):
        if file := re.match(r"# (\w+\.yaml)\n", block):
            Path(file[1]).write_text(block)
    if RECORDINGS[name]:
        file, write = RECORDINGS[name]
        write(Path(file))


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_page_prints_what_its_commands_print(name, tmp_path, monkeypatch, capsys):
    """`...` stands for left-out lines."""
    monkeypatch.chdir(tmp_path)
    page = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    write_inputs(name, page)
    shown = [block for block in blocks(page, "text") if block.startswith("$ driftjax ")]
    assert shown
    for block in shown:
        command, *lines = block.rstrip().split("\n")
        assert main(command.split()[2:]) == 0
        said = [line.rstrip() for line in capsys.readouterr().out.strip().split("\n")]
        assert [line for line in lines if line.rstrip() not in [*said, "..."]] == []
        assert "..." in lines or len(lines) == len(said)


@pytest.mark.slow
def test_the_two_wrong_stiffnesses_of_the_matlab_example_are_named_and_nothing_else(tmp_path, monkeypatch):
    """Six others were, too, while its inputs were taken for held ones."""
    monkeypatch.chdir(tmp_path)
    page = (PAGES / "matlab.md").read_text(encoding="utf-8")
    write_inputs("matlab", page)
    (command,) = re.findall(r"^driftjax (diagnose .*)$", page, re.MULTILINE)
    assert main(command.split()) == 0
    diagnosis = json.loads(Path("runs/v70/diagnosis.json").read_text())
    causes = {cause["effect"]: cause["parameters"]["p"] for cause in diagnosis["causes"]}
    assert diagnosis["verdict"] == "NAMED" and set(causes) == {"friction", "drive_gain"}
    for effect, truth in (("friction", 1 / 4), ("drive_gain", 1 / 3)):
        low, high = causes[effect]["ci95"]
        assert low <= truth <= high and high - low < 0.02


@pytest.mark.slow
def test_after_calibration_on_one_f1tenth_bag_another_shows_its_softer_tyres_and_nothing_else(tmp_path, monkeypatch):
    """Both axles of the second car are a third softer; seven effects were named while an IMU gave the force."""
    monkeypatch.chdir(tmp_path)
    page = (PAGES / "f1tenth.md").read_text(encoding="utf-8")
    write_inputs("f1tenth", page)
    f1tenth_bag(Path("other_bag"), stiffness=30.0, seed=1)
    assert main(["inspect", "my_bag", "--guess", "--vehicle", "f1tenth.yaml", "--write", "map.yaml"]) == 0
    for command in re.findall(r"^driftjax (.*)$", page, re.MULTILINE):
        assert main(command.split()) == 0
    diagnosis = json.loads(Path("runs/other/diagnosis.json").read_text())
    (cause,) = diagnosis["causes"]
    before = yaml.safe_load(Path("runs/fitted/calibrated.yaml").read_text())["effects"]["friction"]["p"]["value"]
    assert diagnosis["verdict"] == "NAMED" and cause["effect"] == "friction"
    assert (1 + cause["parameters"]["p"]["value"]) / (1 + before) == pytest.approx(30 / 45, abs=0.06)


@pytest.mark.slow
def test_the_friction_of_the_second_of_two_logs_is_the_difference(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (PAGES / "compare.md").read_text(encoding="utf-8")
    for command in re.findall(r"^driftjax (simulate .*|compare dry/.*)$", page, re.MULTILINE):
        assert main([*command.split(), *(["--out", "runs/both"] if command.startswith("compare") else [])]) == 0
    comparison = json.loads(Path("runs/both/compare.json").read_text())
    (difference,) = comparison["differences"]
    size = difference["parameters"]["p"]
    assert comparison["verdict"] == "NAMED" and difference["effect"] == "friction"
    assert size["ci95"][0] <= -0.06 <= size["ci95"][1] and size["ci95"][1] - size["ci95"][0] < 0.05
