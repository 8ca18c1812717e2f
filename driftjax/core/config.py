"""Convert dataclass configs to and from YAML; unknown keys and wrong types raise errors that name the key."""

import dataclasses
import functools
import math
import types
import typing
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from driftjax.core.errors import BadInput
from driftjax.core.yamlfile import shown, written_float

T = TypeVar("T")


def configs_dir() -> Path:
    """Return the folder of the shipped YAML files: beside the package in a checkout, inside it in a wheel."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


def find_config(kind: str, name: str | Path) -> Path:
    """Return the path of `name`: a file path as given, else `configs/<kind>/<name>.yaml`.

    Raises `BadInput` when neither exists, listing what does.
    """
    typed = Path(name)
    if typed.is_file():
        return typed
    shipped = configs_dir() / kind / f"{typed.name.removesuffix('.yaml')}.yaml"
    if shipped.is_file():
        return shipped
    known = ", ".join(sorted(p.stem for p in (configs_dir() / kind).glob("*.yaml"))) or "none"
    raise BadInput(f"{name}: no such file; give a path that exists or one of the shipped {kind} names: {known}.")


def from_dict(cls: type[T], values: dict[str, Any], where: str) -> T:
    """Build dataclass `cls` from `values`; `where` names the source in errors.

    Lists become tuples, nested mappings nested dataclasses, integers floats where a float is wanted.
    """
    hints = _hints(cls)
    if unknown := sorted(str(key) for key in values if key not in hints):
        raise BadInput(f"{where}: unknown key '{unknown[0]}'; known keys are {', '.join(sorted(hints))}.")
    fields = {field.name: field for field in dataclasses.fields(cls)}  # pyright: ignore[reportArgumentType]
    for name, field in fields.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in values:
            raise BadInput(f"{where}: key '{name}' is missing; add it.")
    built = {key: _convert(hints[key], value, f"{where}: key '{key}'") for key, value in values.items()}
    try:
        return cls(**built)
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from None


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin, args = get_origin(hint), get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        options = [arg for arg in args if arg is not type(None)]
        for option in options:
            try:
                return _convert(option, value, where)
            except BadInput:
                if option is options[-1]:
                    raise
    if origin is typing.Literal:
        if value not in args:
            raise BadInput(f"{where} is {shown(value)}; choose one of {', '.join(map(str, args))}.")
        return value
    if origin is tuple:
        return _convert_tuple(args, value, where)
    if origin is dict:
        if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
            raise BadInput(f"{where} is {shown(value)}; it needs keys of its own, which are words.")
        return value if args[1] is Any else {key: _convert(args[1], item, where) for key, item in value.items()}
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise BadInput(f"{where} is {shown(value)}; it needs keys of its own.")
        return from_dict(typing.cast(type, hint), value, where)
    if hint is float and (number := written_float(value)) is not None:
        require(math.isfinite(number), f"{where} is {shown(value)}; it needs a finite number.")
        return number
    if hint is Path and isinstance(value, str):
        return Path(value)
    if isinstance(value, hint) and not (hint is int and isinstance(value, bool)):
        return value
    raise BadInput(f"{where} is {shown(value)}; it needs a value of type {hint.__name__}.")


def _convert_tuple(args: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise BadInput(f"{where} is {shown(value)}; it needs a list.")
    if len(args) == 2 and args[1] is Ellipsis:
        return tuple(_convert(args[0], item, where) for item in value)
    if len(value) != len(args):
        raise BadInput(f"{where} has {len(value)} entries; it needs {len(args)}.")
    return tuple(_convert(arg, item, where) for arg, item in zip(args, value, strict=True))


def require_finite(config: Any) -> None:
    """Raise `BadInput` where a number in a config, or in one nested in it, is NaN or infinite."""
    for name, value in flatten_config(to_dict(config)).items():
        require(not isinstance(value, float) or math.isfinite(value), f"key '{name}' is {value}; give a finite number.")


def to_dict(config: Any) -> dict[str, Any]:
    """Return a config as a plain mapping for YAML (tuples become lists, paths strings)."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return str(value) if isinstance(value, Path) else value

    return plain(dataclasses.asdict(config))


def merge_config(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Return `base` updated with the values of `over`, recursively in nested mappings."""
    both = {key: merge_config(base[key], value) for key, value in over.items()
            if isinstance(value, dict) and isinstance(base.get(key), dict)}  # fmt: skip
    return base | over | both


def flatten_config(config: dict[str, Any]) -> dict[str, Any]:
    """Return `config` with one key per value: `gp.size` for nested keys, `path.Q.0` for entries of lists."""

    def pairs(name: str, value: Any) -> list[tuple[str, Any]]:
        if not isinstance(value, dict | list) or not value:
            return [(name, value)]
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return [pair for key, item in items for pair in pairs(f"{name}.{key}", item)]

    return dict(pair for key, value in config.items() for pair in pairs(str(key), value))


def set_option(config: dict[str, Any], name: str, value: Any) -> None:
    """Set, in place, the value or branch with the flattened name `name`; raises `BadInput` for an unknown name."""
    branch: Any = config
    *way, last = name.split(".")
    for part in way:
        branch = branch[_key(branch, part, name)]
    branch[_key(branch, last, name)] = value


def _key(branch: Any, part: str, name: str) -> Any:
    """Return the key or index of `branch` written as `part` in the option name `name`."""
    inside = branch if isinstance(branch, dict) else range(len(branch)) if isinstance(branch, list) else ()
    keys = {str(key): key for key in inside}
    if part not in keys:
        known = f"; there are {', '.join(keys)}" if keys else ""
        raise BadInput(f"there is no option '{name}': '{part}' is unknown{known}.")
    return keys[part]


def require_at_least(config: Any, least: int, *names: str) -> None:
    """Raise `BadInput` for the first option of `names` below `least`; None passes."""
    for name in names:
        value = getattr(config, name)
        zero = "it must not be negative" if isinstance(value, float) else "give 0 or more"
        remedy = f"give at least {least}" if least else zero
        require(value is None or value >= least, f"key '{name}' is {value}; {remedy}.")


def require_positive(config: Any, *names: str) -> None:
    """Raise `BadInput` for the first option of `names` that is not above 0; None passes."""
    for name in names:
        value = getattr(config, name)
        require(value is None or value > 0, f"key '{name}' is {value}; it must be positive.")


def require(condition: bool, sentence: str) -> None:
    """Raise `BadInput(sentence)` unless `condition` holds: for `__post_init__` of configs."""
    if not condition:
        raise BadInput(sentence)
