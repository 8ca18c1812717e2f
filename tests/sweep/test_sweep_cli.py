"""`driftjax sweep` and `driftjax runs` over real laps; bad sweeps end with one sentence, code 2 and no folder."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

import driftjax as dj
from driftjax.cli import main
from driftjax.core import find_config
from driftjax.studies.sweepable_verbs import diagnose_files

# The programs are those of tests/learn/test_loop.py: only numbers differ.
SMALL = {
    "base": {"plants": 1, "seed": 3, "compare": False, "gpr_laps": 0},
    "fields": {"path.Q_path.0": [30.0, 60.0]},
}


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(content) -> str:
    Path("sweep.yaml").write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return "sweep.yaml"


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A folder with a finished sweep of two laps in runs/s."""
    path = tmp_path_factory.mktemp("swept")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        assert main(["sweep", written(SMALL), "--out", "runs/s", "--workers", "1"]) == 0
    return path


def test_laps_are_swept_once_and_found_again(swept, monkeypatch, capsys):
    monkeypatch.chdir(swept)
    assert main(["sweep", "sweep.yaml", "--out", "runs/s", "--workers", "1"]) == 0
    assert "2 trials were kept from before, 0 ran" in capsys.readouterr().out
    again = dj.run_sweep("sweep.yaml", "runs/s", workers=1)
    assert again.num_known == 2 and again.counts.total() == 0 and again.analysis.status["done"] == 2
    assert dj.find_laps(Path("runs"), "stage = 'nominal'", 5)[2] == 2
    assert main(["runs", "--where", "stage = 'nominal' and completed and \"path.Q_path.0\" > 50"]) == 0
    out = capsys.readouterr().out
    assert "1 laps" in out and "sedan" in out
    assert {path.name for path in Path("runs/s").iterdir()} >= {
        "config.yaml",
        "versions.json",
        "results.json",
        "trials",
    }
    assert Path("runs/s/figures/main_effects.png").stat().st_size > 5000


@pytest.mark.parametrize(
    "content, words",
    [
        ("fields: [", "sweep.yaml, line 1: not valid YAML"),
        ({}, "sweep.yaml: key 'fields' is missing"),
        (SMALL | {"verb": "drive"}, "sweep.yaml: key 'verb' is 'drive'; choose one of learn, diagnose, paper"),
        (SMALL | {"fields": {"gp.sizes": [1]}}, "there is no option 'gp.sizes': 'sizes' is unknown"),
        (SMALL | {"fields": {"gp.size": [50, 2]}}, "key 'size' is 2; give at least 20 points"),
        (
            SMALL | {"base": {"car": "bus"}},
            "bus: no such file; give a path that exists or one of the shipped learn",
        ),
        (SMALL | {"fields": {"vehicle": ["sedan", "bus"]}}, "bus: no such file"),
        (SMALL | {"fields": {"seed": [1]}, "design": "lhs", "num": -1}, "key 'num' is -1"),
        ({"verb": "diagnose", "fields": {"options.seed": [0]}}, "key 'logs' is missing"),
        ({"verb": "diagnose", "base": {"logs": ["no.csv"]}, "fields": {"options.seed": [0]}}, "no.csv"),
        ({"verb": "paper", "fields": {"plants": [0]}}, "key 'plants' is 0"),
    ],
)
def test_bad_sweeps_leave_nothing(here, capsys, content, words):
    assert main(["sweep", written(content)]) == 2
    error = capsys.readouterr().err
    assert words in error and len(error.splitlines()) == 1 and "Traceback" not in error
    assert [path.name for path in here.iterdir()] == ["sweep.yaml"]


def test_another_sweep_in_the_folder_is_refused(swept, monkeypatch, capsys):
    monkeypatch.chdir(swept)
    Path("other.yaml").write_text(yaml.safe_dump(SMALL | {"fields": {"seed": [1]}}))
    assert main(["sweep", "other.yaml", "--out", "runs/s"]) == 2
    assert "runs/s: holds a sweep over other fields or options" in capsys.readouterr().err
    assert main(["runs", "--where", "lateral_error <", "--root", "runs"]) == 2
    assert "--where: Parser Error" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_reported(here, capsys):
    Path("file").write_text("")
    assert main(["sweep", written(SMALL), "--out", "file/s"]) == 2
    assert "file/s: cannot be" in capsys.readouterr().err


FULL = """
import resource, sys
from driftjax.cli import main
from driftjax.studies.sweepable_verbs import WORKS, diagnose_files
from driftjax.core import find_config
from tests.sweep.toy import TOY
WORKS["learn"] = TOY  # what a verb computes does not matter here
codes = [main(["sweep", "sweep.yaml", "--out", "s", "--workers", "1"])]
resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))  # no byte more
codes.append(main(["sweep", "more.yaml", "--out", "s", "--workers", "1"]))
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.getrlimit(resource.RLIMIT_FSIZE)[1],) * 2)
codes.append(main(["sweep", "more.yaml", "--out", "s", "--workers", "1"]))
print(codes)
"""


def test_a_disk_without_room_ends_with_a_sentence_and_loses_nothing(here):
    sweep = {"design": "random", "num": 4, "fields": {"x": {"low": 0.0, "high": 1.0}}}
    written(sweep)
    Path("more.yaml").write_text(yaml.safe_dump(sweep | {"num": 6}))
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run([sys.executable, "-c", FULL], env=env, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[0, 1, 0]", done.stdout + done.stderr
    [sentence] = done.stderr.splitlines()
    assert "File too large" in sentence and "what was computed is in s; continue with: driftjax sweep" in sentence
    assert "4 trials were kept from before, 2 ran" in done.stdout
    names = {path.name for path in Path("s").rglob("*") if path.is_file() and path.suffix != ".png"}
    assert not {name for name in names if name.startswith(".") or name == "error.txt"}


SLOW = """
import sys
from driftjax.cli import main
from driftjax.studies.sweepable_verbs import WORKS, diagnose_files
from driftjax.core import find_config
from tests.sweep.toy import TOY
WORKS["learn"] = TOY
sys.exit(main(["sweep", "sweep.yaml", "--out", "s", "--workers", "1"]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_sweep_says_how_to_go_on_and_does(here, number, code):
    written({"design": "random", "num": 40, "base": {"pause": 0.1}, "fields": {"x": {"low": 0.0, "high": 1.0}}})
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-c", SLOW]
    process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not list(Path("s").glob("trials/*.parquet")):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    _, error = process.communicate()
    [sentence] = error.splitlines()
    assert process.returncode == code
    assert "stopped; what was computed is in s; continue with: driftjax sweep" in sentence
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    kept, ran = map(int, re.findall(r"(\d+) trials were kept from before, (\d+) ran", done.stdout)[0])
    assert done.returncode == 0 and kept > 0 and ran > 0 and kept + ran == 40


def test_a_diagnosis_in_a_sweep_is_known_by_all_its_files(tmp_path):
    """The column map and the vehicle count by their contents, shipped ones too, and a ROS 2 bag is a folder."""
    (tmp_path / "map.yaml").write_text("columns: {}")
    (tmp_path / "bag").mkdir()
    known = lambda **options: diagnose_files({"columns": None, "vehicle": "sedan", "logs": ["a.csv"]} | options)
    for name in ("drive.erg", "drive.erg.info"):
        (tmp_path / name).touch()
    assert tmp_path / "drive.erg.info" in known(logs=[str(tmp_path / "drive.erg")])
    assert known() == [Path("a.csv"), find_config("vehicle", "sedan")]
    own = known(columns=str(tmp_path / "map.yaml"), logs=[str(tmp_path / "bag")])
    assert own == [tmp_path / "bag", find_config("vehicle", "sedan"), tmp_path / "map.yaml"]
    assert known(columns="genesis_g80")[-1] == find_config("columns", "genesis_g80")
