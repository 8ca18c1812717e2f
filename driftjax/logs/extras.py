"""Optional libraries for some log formats: import them by extra, and convert their errors to one sentence."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import shorten
from typing import Any

from driftjax.core import BadInput


def import_extra(path: Path | str, kind: str, extra: str, module: str) -> Any:
    """Import a module for reading or writing `path`; raises `BadInput` that names the extra if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise BadInput(
            f"{path}: {kind} needs the extra '{extra}'; install it with pip install 'driftjax[{extra}]'."
        ) from None


@contextmanager
def library_errors(path: Path, kind: str, remedy: str) -> Iterator[None]:
    """Raise `BadInput` with `remedy` if a library cannot read `path`; damaged bytes can raise any exception."""
    try:
        yield
    except BadInput:
        raise
    except Exception as error:
        reason = one_line(str(error)) or type(error).__name__
        raise unreadable(path, kind, reason, remedy) from error


def unreadable(path: Path, kind: str, reason: str, remedy: str) -> BadInput:
    """Return the error of a file that its library cannot read."""
    return BadInput(f"{path}: is no readable {kind} ({reason}); {remedy}.")


def one_line(message: str) -> str:
    """Return the message of a library in one line without control characters, shortened, to stand in a sentence."""
    return shorten(printable(message), 120).rstrip(".")


def printable(text: str) -> str:
    """Return text of a file as a message may quote it, control characters as spaces."""
    return "".join(letter if letter.isprintable() else " " for letter in text)
