"""Read YAML files: what is wrong with one is said in one sentence."""

import math
import re
import reprlib
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from driftjax.core.errors import BadInput

# what YAML 1.2 reads as a number, and PyYAML, which is of YAML 1.1, as text for want of a point or a sign
EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)e[-+]?\d+", re.IGNORECASE)
MOST_SHOWN = 120  # letters of a value in a message
_SHORT = reprlib.Repr()
_SHORT.maxlevel = 2
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 80


class _RepeatedKey(yaml.YAMLError):
    """A key is there twice in one mapping."""

    def __init__(self, key: str, node: yaml.Node) -> None:
        super().__init__(key)
        self.key, self.problem_mark = key, node.start_mark


class _Loader(yaml.SafeLoader):
    """Refuses keys that are there twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set[tuple[str, str]]()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode) and key.value != "<<"):
            if (key.tag, key.value) in seen:
                raise _RepeatedKey(key.value, key)
            seen.add((key.tag, key.value))
        return super().construct_mapping(node, deep)


def shown(value: Any) -> str:
    """Return a value as messages show it: no longer than a line."""
    text = _SHORT.repr(value)
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."


def written_float(value: Any) -> float | None:
    """Return a number, `1e-3` too, infinite if too large; None for any other value."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    if isinstance(value, str) and not EXPONENT.fullmatch(value):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the mapping in a YAML file; raises `BadInput` that names the file if it holds anything else."""
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file; check the path.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: cannot be read ({error}); check the file and its permissions.") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path}, line {mark.line + 1}" if mark else f"{path}"
        if isinstance(error, _RepeatedKey):
            raise BadInput(f"{where}: key {shown(error.key)} is there twice; leave one.") from None
        raise BadInput(f"{where}: not valid YAML; check indentation and colons.") from None
    except RecursionError:
        raise BadInput(f"{path}: nests lists or keys too deeply; write them flat.") from None
    except ValueError as error:  # no such day, or a number of thousands of digits
        raise BadInput(f"{path}: holds a date or number that cannot be read ({error}); correct it.") from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise BadInput(f"{path}: holds {type(content).__name__}, not keys with values; write 'key: value' lines.")
    return content
