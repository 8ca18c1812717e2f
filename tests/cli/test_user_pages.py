"""Pages for one kind of user: their commands run, and print what the pages show."""

import re
from pathlib import Path

import pytest
from drives import f1tenth_bag, vehicle_mat

from driftjax.cli import main

PAGES = Path(__file__).parents[2] / "docs/how-to"
RECORDINGS = {"f1tenth": ("my_bag", f1tenth_bag), "matlab": ("vehicle.mat", vehicle_mat), "race-stack": None}


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_page_prints_what_its_commands_print(name, tmp_path, monkeypatch, capsys):
    """A block of YAML that begins with the name of a file is that file; `...` stands for left-out lines."""
    monkeypatch.chdir(tmp_path)
    page = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    for block in blocks(page, "yaml"):
        if file := re.match(r"# (\w+\.yaml)\n", block):
            Path(file[1]).write_text(block)
    if RECORDINGS[name]:
        file, write = RECORDINGS[name]
        write(Path(file))
    shown = [block for block in blocks(page, "text") if block.startswith("$ driftjax ")]
    assert shown
    for block in shown:
        command, *lines = block.rstrip().split("\n")
        assert main(command.split()[2:]) == 0
        said = [line.rstrip() for line in capsys.readouterr().out.strip().split("\n")]
        assert [line for line in lines if line.rstrip() not in [*said, "..."]] == []
        assert "..." in lines or len(lines) == len(said)
