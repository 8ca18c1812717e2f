"""Shared by the verbs: flags over files, work inside a run folder, progress."""

import argparse
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import tyro

from driftjax.cli.front import Terminated
from driftjax.core import BadInput, write_atomically
from driftjax.core.config import require_finite
from driftjax.store import RunFolder

T = TypeVar("T")
Report = Callable[[str, int, int], None]


def early_flags(argv: list[str], *flags: str) -> tuple[dict[str, str | None], list[str]]:
    """Parse the flags that set the defaults of all others; returns their values and the other arguments."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for flag in flags:
        early.add_argument(f"--{flag}", nargs="?")
    known, others = early.parse_known_args(argv)
    return vars(known), others


def parse(cls: type[T], argv: list[str], prog: str, default: T | None = None) -> T:
    """Parse flags over `default` into a `cls`; raises `BadInput` where its checks fail."""
    given: dict[str, Any] = {} if default is None else {"default": default}
    try:
        options = tyro.cli(cls, args=argv, prog=prog, **given)
        require_finite(options)
        return options
    except BadInput as error:
        raise BadInput(f"flags: {error}") from None


def default_out(verb: str, name: str) -> Path:
    """Return the run folder used without --out."""
    return Path("runs") / f"{verb}-{name}-{time.strftime('%Y%m%d-%H%M%S')}"


def run_in(folder: RunFolder, work: Callable[[], int], resume: str = "") -> int:
    """Run `work`; on failure print what was stored and how to resume."""
    kept = f"what was computed is in {folder.path}" + (f"; continue with: {resume}" if resume else ".")
    try:
        return work()
    except BadInput:
        if not folder.has_results():
            folder.discard()
        raise
    except (KeyboardInterrupt, Terminated) as stop:
        raise type(stop)(f"stopped; {kept}") from None
    except Exception as error:
        text, words, see = traceback.format_exc(), " ".join(str(error).split())[:300], "see error.txt; "
        try:
            write_atomically(folder.path / "error.txt", lambda path: path.write_text(text, encoding="utf-8"))
        except OSError:  # the disk may be what failed; its message is printed anyway
            see = ""
        print(f"driftjax: failed ({type(error).__name__}: {words}); {see}{kept}", file=sys.stderr)
        return 1


def print_notes(notes: Iterable[str]) -> None:
    """Print notes, such as those of a log or the `unmodelled_effects` of a car."""
    for note in notes:
        print(f"note: {note}", flush=True)


@contextmanager
def progress() -> Iterator[Report]:
    """Yield `report(text, done, total)`: a bar with the time left on a terminal, plain lines elsewhere."""
    if not sys.stderr.isatty():
        start = time.monotonic()
        yield lambda text, done, total: print(f"[{time.monotonic() - start:6.1f} s] {done}/{total} {text}", flush=True)
        return
    from tqdm import tqdm

    with tqdm(total=1, bar_format="{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}, {remaining} left]") as bar:

        def show(text: str, done: int, total: int) -> None:
            bar.total, bar.n = total, done
            bar.set_description(text, refresh=False)
            bar.refresh()

        yield show
