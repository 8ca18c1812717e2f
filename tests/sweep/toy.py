"""A verb that costs nothing: what a sweep does with trials, whatever they are."""

import json
import math
import os
import signal
import time
from pathlib import Path

from driftjax.core import BadInput, merge_config
from driftjax.sweep import Work

COLUMNS = {"stage": str, "lateral_error": float, "lap_time": float}
DEFAULTS = {"x": 1.0, "kind": "good", "gp": {"size": 3, "P": [1.0, 2.0]}, "pause": 0.0, "trace": ""}


def complete(options):
    """Options over the defaults; `kind` may be good, nan, raises, kills or kills-once."""
    for name in options:
        if name not in DEFAULTS:
            raise BadInput(f"a trial: unknown key '{name}'.")
    whole = merge_config(DEFAULTS, options)
    if not isinstance(whole["x"], int | float) or not math.isfinite(whole["x"]):
        raise BadInput(f"a trial: key 'x' is {whole['x']!r}; give a number.")
    return json.loads(json.dumps(whole))


def files(config):
    """None."""
    return []


def rows(config, executor, folder: Path):
    """Two steps, the second better; every trial begun leaves a line in the file `trace`."""
    if config["trace"]:
        with open(config["trace"], "a") as stream:
            stream.write(f"{config['x']}\n")
    time.sleep(config["pause"])
    kind, error = config["kind"], (config["x"] - 2.0) ** 2 + 0.1 * config["gp"]["size"] * config["gp"]["P"][0]
    if kind == "raises":
        raise ArithmeticError("the car left the planet")
    if kind == "kills" or (kind == "kills-once" and not folder.exists()):
        folder.mkdir(parents=True, exist_ok=True)
        os.kill(os.getpid(), signal.SIGKILL)
    yield [{"stage": "first", "lateral_error": 2 * error, "lap_time": None}]
    last = None if kind == "nan" else error
    yield [{"stage": "last", "lateral_error": last, "lap_time": 1.0 + config["x"]}]


TOY = Work(complete, files, rows, COLUMNS)
