"""Generated nonsense in configs, sweeps, tracks and logs: code 2, one sentence naming the place, no file left."""

import contextlib
import copy
import io
import os
import tempfile
from pathlib import Path

import numpy as np
import yaml
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from driftjax.cli import main
from driftjax.core.config import flatten_config, set_option, to_dict
from driftjax.learning.config import load_learn_config
from driftjax.logs.columns import OPTIONAL

DEFAULTS = to_dict(load_learn_config("rc"))
NUMBERS = [
    name
    for name, value in flatten_config(DEFAULTS).items()
    if isinstance(value, int | float) and not isinstance(value, bool) and "plant" not in name
]
SOME = settings(max_examples=50, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
WORDS = st.text("abcdefghijklmnopqrstuvwxyz", min_size=3, max_size=9)
# What stands for no number in any option: other types, and numbers that are none.
NONSENSE = st.one_of(WORDS, st.just(float("nan")), st.just(float("inf")), st.just([]), st.just({"a": 1}), st.just(True))


def refused(argv: list[str], files: dict[str, str | bytes], *places: str) -> None:
    """The command ends with code 2 and one sentence with any of the `places` in it, and leaves only `files`."""
    before = os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            for name, content in files.items():
                Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())
            errors = io.StringIO()
            with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
                code = main(argv)
            left = {path.name for path in Path().iterdir()}
        finally:
            os.chdir(before)
    sentence = errors.getvalue()
    assert code == 2, sentence
    assert len(sentence.strip().splitlines()) == 1 and "Traceback" not in sentence, sentence
    assert any(place in sentence for place in places), sentence
    assert left == set(files)


@SOME
@given(st.sampled_from(NUMBERS), NONSENSE)
def test_options_that_are_no_numbers(name, value):
    config = copy.deepcopy(DEFAULTS)
    set_option(config, name, value)
    last = name.split(".")[-1]
    places = (f"'{last}'",) if not last.isdecimal() else (f"'{name.split('.')[-2]}'",)
    refused(["learn", "--config", "c.yaml"], {"c.yaml": yaml.safe_dump(config)}, *places)


@SOME
@given(st.sampled_from(["", "gp.", "mpc.", "explore.", "switch.", "lap."]), WORDS, st.integers(-9, 9))
def test_options_that_do_not_exist(branch, word, value):
    config = copy.deepcopy(DEFAULTS)
    at = config[branch[:-1]] if branch else config
    assume(word not in at)
    at[word] = value
    refused(["learn", "--config", "c.yaml"], {"c.yaml": yaml.safe_dump(config)}, f"unknown key '{word}'")


@SOME
@given(st.sampled_from(NUMBERS), NONSENSE, WORDS)
def test_sweeps_over_nonsense(name, value, word):
    fields = {name: [value]} if not isinstance(value, list | dict) else {word: [1.0]}
    sweep = {"base": {"car": "rc"}, "fields": fields}
    refused(
        ["sweep", "s.yaml"], {"s.yaml": yaml.safe_dump(sweep)}, *(f"'{part}" for part in next(iter(fields)).split("."))
    )


@SOME
@given(st.binary(min_size=1, max_size=60))
def test_files_of_any_bytes_are_no_sweeps(content):
    refused(["sweep", "s.yaml"], {"s.yaml": content}, "s.yaml")


def track(rows: np.ndarray) -> str:
    return "\n".join(",".join(map(str, row)) for row in rows)


@SOME
@given(st.integers(0, 39), st.integers(0, 3), st.one_of(WORDS, st.sampled_from(["nan", "inf", "", "1e999"])))
def test_tracks_with_a_bad_cell(row, column, cell):
    angle = np.linspace(0, np.pi, 40)
    rows = np.column_stack([30 * np.cos(angle), 30 * np.sin(angle), np.full(40, 4.0), np.full(40, 4.0)]).astype(object)
    rows[row, column] = cell
    refused(["plan", "--track", "t.csv"], {"t.csv": track(rows)}, f"t.csv, row {row + 1}:")


def log(columns: dict[str, list]) -> str:
    lines = [",".join(columns)] + [",".join(map(str, row)) for row in zip(*columns.values(), strict=True)]
    return "\n".join(lines) + "\n"


@SOME
@given(st.sampled_from(["t", "V", "beta", "r", "delta", "Fxr"]), st.integers(0, 99), WORDS, st.booleans())
def test_logs_with_a_bad_cell_or_without_a_channel(name, row, word, without):
    columns: dict[str, list] = {key: [0.01 * i if key == "t" else 1.0 for i in range(100)]
                                for key in ("t", "V", "beta", "r", "delta", "Fxr")}  # fmt: skip
    if without and name not in OPTIONAL:
        del columns[name]
        place = f"l.csv: column '{name}' is missing"
    else:
        columns[name][row] = word
        place = f"l.csv, row {row + 2}: column '{name}' holds '{word}'"
    refused(["diagnose", "l.csv"], {"l.csv": log(columns)}, place)
