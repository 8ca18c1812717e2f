"""Reference of the command line and of the configuration files as MyST Markdown, from the options themselves."""

import argparse
import dataclasses
import importlib
import inspect
import re
import warnings
from collections.abc import Iterator
from typing import Any
from unittest import mock

import tyro
from api import definition, markdown
from tables import table

from driftjax.cli.front import VERBS
from driftjax.control.mpc import MPCConfig, Weights
from driftjax.diagnosis.compare import CompareConfig
from driftjax.diagnosis.held_out import DiagnoseConfig
from driftjax.learning.config import LearnConfig
from driftjax.logs.columns import Channel, ColumnMap, Condition, Drive
from driftjax.planner.config import PlanConfig
from driftjax.sim.sensors import SensorConfig
from driftjax.sweep.config import Range, SweepConfig
from driftjax.track.load import CornerConfig, CsvConfig, PlaygroundConfig
from driftjax.vehicle.parameters import VehicleConfig
from driftjax.vehicle.plant_config import PlantConfig

FILES = {
    "Learning": ("`configs/learn/`, used by `driftjax learn --config`", (LearnConfig,)),
    "Planner": ("`configs/plan/`, used by `--plan`", (PlanConfig,)),
    "Car": ("`configs/vehicle/`, used by `--vehicle`", (VehicleConfig,)),
    "Plant": ("`configs/plant/`, used by `--plant`", (PlantConfig,)),
    "Sensor noise": ("`configs/sensors/`, used by `--sensors`", (SensorConfig,)),
    "Track": ("`configs/track/`, used by `--track`", (CornerConfig, PlaygroundConfig, CsvConfig)),
    "Column map": ("`configs/columns/`, used by `--columns`", (ColumnMap, Channel, Condition, Drive)),
    "Diagnosis": ("Options of `driftjax diagnose` and of `dj.diagnose`", (DiagnoseConfig,)),
    "Comparison of two logs": ("Options of `driftjax compare` and of `dj.compare`", (CompareConfig,)),
    "Sweep": ("`configs/sweep/`, used by `driftjax sweep`", (SweepConfig, Range)),
}
REPEATED = (MPCConfig, Weights)  # stand once though several keys hold one


class _Caught(Exception):
    """Carries the arguments of `tyro.cli` out of a verb."""


def command_pages() -> dict[str, str]:
    """Return a page for each verb: its options by group, with meaning and default."""
    return {verb: _command_page(verb) for verb in VERBS}


def configuration_page() -> str:
    """Return a table of keys for each kind of configuration file."""
    parts = []
    for heading, (place, classes) in FILES.items():
        parts.append(f"## {heading}\n\n{place}.\n")
        for cls in classes:
            parts += list(_class_tables(cls, "", classes.index(cls) > 0))
    return "\n".join(parts)


def cell(text: str) -> str:
    """Return `text` as one cell of a table."""
    return " ".join(text.split()).replace("|", "\\|")


def _parser(verb: str) -> argparse.ArgumentParser:
    def catch(cls: Any, args: Any = None, prog: str | None = None, **options: Any) -> None:
        raise _Caught(cls, prog, options)

    with mock.patch.object(tyro, "cli", catch), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            importlib.import_module(f"driftjax.cli.{verb}").run(["--help"])
        except _Caught as caught:
            cls, prog, options = caught.args
            return tyro.extras.get_parser(cls, prog=prog, **options)
    raise AssertionError(f"driftjax {verb} does not parse its flags with tyro.cli")


def _command_page(verb: str) -> str:
    parser = _parser(verb)
    parts = [f"# driftjax {verb}\n", markdown(parser.description or "") + "\n"]
    for group in parser._action_groups:
        rows = [_option(action) for action in group._group_actions if action.dest != "help"]
        if rows:
            parts += [f"## {_title(group.title or '')}\n", f"{group.description or ''}\n",
                      table(("option", "meaning", "default"), rows)]  # fmt: skip
    return "\n".join(parts)


def _title(group: str) -> str:
    return {"positional arguments": "Arguments", "options": "Options"}.get(group, f"`--{group.split()[0]}.*`")


def _option(action: argparse.Action) -> tuple[str, str, str]:
    match = re.fullmatch(r"(.*?)\s*(?:\((default: .*|required|optional|repeatable)\))?", action.help or "", re.DOTALL)
    assert match is not None
    default = (match[2] or "").removeprefix("default:").strip()
    value = str(action.metavar or "").replace("{None}|", "")
    names = ", ".join(action.option_strings) or action.dest
    return f"`{cell(f'{names} {value}')}`", cell(match[1]), "" if default in ("", "None") else f"`{cell(default)}`"


def _class_tables(cls: type, prefix: str, named: bool) -> Iterator[str]:
    """Yield heading, sentence and table of a class of options, then of those nested in it."""
    if prefix or named:
        yield f"### `{prefix.rstrip('.')}`\n" if prefix else f"### {cls.__name__}\n"
    yield markdown(inspect.getdoc(cls) or "") + "\n"
    source, rows, nested = definition(cls), [], dict[str, type]()
    for field in dataclasses.fields(cls):
        one = source.members[field.name]
        default = _default(field)
        if isinstance(default, REPEATED) or (dataclasses.is_dataclass(default) and not isinstance(default, type)):
            nested[field.name] = type(default)
        doc = one.docstring.value if one.docstring else "see below" if field.name in nested else ""
        shown = "" if field.name in nested else _value(default)
        rows.append((f"`{prefix}{field.name}`", cell(doc), shown, f"`{cell(str(one.annotation))}`"))
    yield table(("key", "meaning", "default", "type"), rows)
    for name, inner in nested.items():
        yield from _class_tables(inner, f"{prefix}{name}.", True)


def _default(field: dataclasses.Field) -> Any:
    return field.default_factory() if field.default_factory is not dataclasses.MISSING else field.default


def _value(default: Any) -> str:
    if default is dataclasses.MISSING:
        return "(required)"
    return "" if default is None or default in ((), "", {}) else f"`{cell(str(default))}`"
