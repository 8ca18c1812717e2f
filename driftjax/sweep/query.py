"""Query the laps of all run folders and sweeps as one DuckDB table `laps`."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa

from driftjax.core import BadInput, flatten_config
from driftjax.store import RunFolder, list_runs
from driftjax.store.lap_rows import LAP_COLUMNS, lap_rows
from driftjax.sweep.store import PARTS

SHOWN = ("folder", "trial", "car", "stage", "controller", "plant", "noise_seed", "completed", "lateral_error",
         "velocity_rmse", "lap_time")  # fmt: skip


def open_laps(root: Path) -> duckdb.DuckDBPyConnection:
    """Open a database whose view `laps` has one row per lap below `root`: figures, options by dotted names, `folder`,
    `verb`, `trial` of a sweep and all its options as JSON in `config`."""
    database, parts = duckdb.connect(), []
    for run in list_runs(root):
        name = f"part{len(parts)}"
        files = [str(path) for path in sorted((run.path / PARTS).glob("*.parquet"))]
        if run.verb == "sweep" and files:
            fixed = {"folder": str(run.path), "verb": str(run.config["verb"])} | _car(run.config.get("base", {}))
            extra = ", ".join(f"{_text(value)} as {key}" for key, value in fixed.items())
            held = database.read_parquet(files, union_by_name=True)  # pyright: ignore[reportArgumentType]
            columns = [column for column in held.columns if column not in fixed]
            quoted = ", ".join(f'"{column}"' for column in columns)
            database.register(name, held.project(f"{quoted}, {extra}").to_arrow_table())
        elif rows := list(_rows(run)):
            database.register(name, pa.Table.from_pylist(rows))
        else:
            continue
        parts.append(f"select * from {name}")
    if not parts:
        raise BadInput(f"{root}: holds no finished run; give the folder where they are with --root.")
    database.execute("create view laps as " + " union all by name ".join(parts))
    return database


def _car(options: dict[str, Any]) -> dict[str, str]:
    return {"car": str(options["car"])} if "car" in options else {}


def _text(value: str) -> str:
    return "'" + value.replace("'", "''") + "'"


def _rows(run: RunFolder) -> Iterator[dict[str, Any]]:
    """Yield the laps of a run of `learn`, with its options."""
    if run.verb != "learn" or not run.has("laps.nc"):
        return
    options = {
        key: value for key, value in flatten_config(run.config).items() if isinstance(value, bool | int | float | str)
    }
    known = {"folder": str(run.path), "verb": run.verb, "config": json.dumps(run.config, sort_keys=True)}
    data = run.read_dataset("laps.nc")
    for i, stage in enumerate(data["stage"].values):
        of_stage = data.isel(stage=i)
        driven = np.flatnonzero(of_stage["plant"].values != "")  # a stage with fewer lanes than others is padded
        for row in lap_rows(str(stage), of_stage.isel(lane=driven)):
            yield options | known | row


def find_laps(root: Path, condition: str, limit: int) -> tuple[list[str], list[tuple], int]:
    """Return column names, rows of the laps that meet the SQL `condition`, best first, and their number."""
    database = open_laps(root)
    try:
        laps = database.sql(f"select * from laps where {condition}")
        known = laps.columns
        columns = [name for name in SHOWN if name in known]
        columns += [name for name in known if name not in SHOWN and f'"{name}"' in condition]
        quoted = ", ".join(f'"{name}"' for name in columns)
        order = ' order by "lateral_error" nulls last' if "lateral_error" in known else ""
        num = len(laps)
        rows = database.execute(f"select {quoted} from laps where {condition}{order} limit {limit}").fetchall()
    except duckdb.Error as error:
        names = ", ".join(column for column in LAP_COLUMNS)
        words = " ".join(str(error).split())[:200]
        raise BadInput(f'--where: {words}; columns are car, {names} and options such as "gp.size".') from None
    return columns, rows, num


def read_run(root: Path, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read options by dotted names and mean figures per stage and controller, of a run folder or a sweep's trial."""
    if (Path(name) / "config.yaml").is_file():
        run = RunFolder.open(name)
        return flatten_config(run.config), _means(list(_rows(run)))
    database = open_laps(root)
    selected = database.execute("select * from laps where trial is not null and starts_with(trial, ?)", [name])
    columns = [column[0] for column in selected.description or ()]
    rows = [dict(zip(columns, row, strict=True)) for row in selected.fetchall()]
    trials = {row["trial"] for row in rows}
    if len(trials) != 1:
        many = f"{len(trials)} trials begin so" if trials else "is neither a run folder nor a trial"
        raise BadInput(f"{name}: {many}; give a folder, or a trial's id as `driftjax runs --where` shows it.")
    return flatten_config(json.loads(rows[0]["config"])), _means(rows)


def _means(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return the mean of each figure over the laps of a stage and controller that have it."""
    values_of: dict[str, list[float]] = {}
    for row in rows:
        whose = ", ".join(filter(None, (row.get("stage"), row.get("controller"))))
        for figure in (name for name, kind in LAP_COLUMNS.items() if kind in (float, bool)):
            if row.get(figure) is not None:
                values_of.setdefault(f"{whose}: {figure}", []).append(float(row[figure]))
    return {name: sum(values) / len(values) for name, values in values_of.items()}


def differences(a: dict[str, Any], b: dict[str, Any]) -> list[tuple[str, Any, Any]]:
    """Return (name, value in `a`, value in `b`) wherever they differ; None where one has none."""
    return [(name, a.get(name), b.get(name)) for name in {**a, **b} if a.get(name) != b.get(name)]
