"""Options name files, and these name others: all of them decide what a run or a trial is."""

import dataclasses
from pathlib import Path

from driftjax.core import find_config
from driftjax.learning.config import files_of, load_learn_config

TRACK = "kind: csv\npath: road.csv\n"
ROWS = "".join(f"{x},0.0,3.0,3.0\n" for x in range(0, 200, 5))


def test_files_that_files_name_are_listed(tmp_path: Path):
    (tmp_path / "road.yaml").write_text(TRACK)
    (tmp_path / "road.csv").write_text(ROWS)
    (tmp_path / "car.yaml").write_text("nominal:\n  tyre: soft.tir\n")
    (tmp_path / "soft.tir").write_text("$ nothing")
    for name in ("heavy", "light"):
        (tmp_path / f"{name}.yaml").write_text(f"base: {'light' if name == 'heavy' else 'bare'}\n")
    (tmp_path / "bare.yaml").write_text("tyre: soft.tir\n")
    config = dataclasses.replace(
        load_learn_config("sedan"), track=tmp_path / "road.yaml", vehicle=tmp_path / "car.yaml",
        plant=(tmp_path / "heavy.yaml",),
    )  # fmt: skip
    files = list(files_of(config).values())
    names = {path.name for path in files if path.parent == tmp_path}
    assert names == {"road.yaml", "road.csv", "car.yaml", "soft.tir", "heavy.yaml", "light.yaml", "bare.yaml"}
    assert find_config("plan", config.plan) in files and all(path.is_file() for path in files)
