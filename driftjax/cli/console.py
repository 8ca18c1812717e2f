"""Helpers that all verbs share: parse flags over files, work inside a run folder, report progress."""

import argparse
import os
import shlex
import shutil
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import Any, TextIO, TypeVar

import tyro

from driftjax.cli.front import Terminated
from driftjax.core import BadInput, write_text
from driftjax.core.config import require_finite
from driftjax.core.progress import ProgressReport
from driftjax.store import RunFolder

T = TypeVar("T")

BAR = "{l_bar}{bar}| {n:g}/{total:g} [{elapsed}{postfix}]"
BAR_WITH_RATE = BAR.replace("]", ", {rate_fmt}]")  # where at least one part was done
BESIDE = 55  # columns that a terminal keeps for bar, numbers and times beside the text
RECENT = 4  # parts whose time tells that of the others
SILENCE = 60.0  # between two lines of one text in a log file [s]


def early_flags(argv: list[str], *flags: str) -> tuple[dict[str, str | None], list[str]]:
    """Parse first the `flags` that set the defaults of the others; return their values and the remaining arguments."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for flag in flags:
        early.add_argument(f"--{flag}", nargs="?")
    known, others = early.parse_known_args(argv)
    return vars(known), others


def parse(cls: type[T], argv: list[str], prog: str, default: T | None = None) -> T:
    """Parse flags over `default` into a `cls`; raises `BadInput` where its checks fail."""
    defaults: dict[str, Any] = {} if default is None else {"default": default}
    try:
        options = tyro.cli(cls, args=argv, prog=prog, **defaults)
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
            write_text(folder.path / "error.txt", text)
        except OSError:  # the disk may be what failed; its message is printed anyway
            see = ""
        print(f"driftjax: failed ({type(error).__name__}: {words}); {see}{kept}", file=sys.stderr)
        return 1


def print_notes(notes: Iterable[str]) -> None:
    """Print notes, such as those of a log or the `unmodelled_effects` of a car.

    Of notes that say the same of several logs or runs, `WHERE: what`, the first is printed with their number.
    """
    alike: dict[str, list[str]] = {}
    for note in notes:
        where, separator, what = note.partition(": ")
        alike.setdefault(what if separator else note, []).append(note)
    for first, *others in alike.values():
        print(f"note: {first}{f' The same holds for {len(others)} more.' if others else ''}", flush=True)


def by_steps(report: ProgressReport, steps: Mapping[str, int]) -> Callable[[str], None]:
    """Return a progress report for texts `STEP` or `STEP: details`; `steps` has their usual shares of the time [%]."""
    *before, total = accumulate(steps.values(), initial=0)
    done = dict(zip(steps, before, strict=True))
    return lambda text: report(text, done[text.partition(":")[0]], total)


class TimeLeft:
    """Estimate of the time left, from the time that the last few parts took: the first ones may have compiled."""

    def __init__(self) -> None:
        self.marks: deque[tuple[float, float]] = deque(maxlen=RECENT + 1)  # time [s] and parts done, where these rose
        self.first = self.done = self.each = 0.0  # parts done at first, and now; time of one part [s]

    def count(self, done: float) -> None:
        """Record that `done` parts are finished; those of the first call do not count in the rate."""
        if not self.marks:
            self.first = done
        if not self.marks or done > self.done:
            self.marks.append((time.monotonic(), done))
        if len(self.marks) > 1:
            (begin, before), (end, after) = self.marks[0], self.marks[-1]
            self.each = (end - begin) / (after - before)
        self.done = done

    def text(self, total: float) -> str:
        """Return `MM:SS left`, or nothing where no part was done yet or the present one takes longer than expected."""
        if self.each == 0:
            return ""
        left = (total - self.done) * self.each - (time.monotonic() - self.marks[-1][0])
        if left <= 0:
            return ""
        from tqdm import tqdm

        return f"{tqdm.format_interval(left)} left"


def log_flags(logs: Iterable[Path], columns: str | None, vehicle: Path | str) -> str:
    """Return logs, column map and vehicle as they stand in a command."""
    words = (*map(str, logs), *(("--columns", columns) if columns else ()), "--vehicle", str(vehicle))
    return " ".join(map(shlex.quote, words))


def shortened(text: str, width: int) -> str:
    """Return `text` cut to `width` characters, at least 20, so that the bar beside it is still seen."""
    width = max(width, 20)
    return text if len(text) <= width else text[: width - 3].rstrip(" ,:") + "..."


def has_width(stream: TextIO) -> bool:
    """Return whether `stream` is a terminal with room for a bar."""
    try:
        return stream.isatty() and os.get_terminal_size(stream.fileno()).columns > 0
    except OSError:
        return stream.isatty()


@contextmanager
def progress() -> Iterator[ProgressReport]:
    """Yield `report(text, done, total)`: a bar with rate and time left in a terminal, lines in a log file.

    Both streams must be a terminal for the bar: one that goes into a file or a pipe gets lines instead, as does a
    terminal without a width, such as some build servers have.
    """
    if not (has_width(sys.stdout) and has_width(sys.stderr)):
        yield _report_lines()
        return
    from tqdm import tqdm

    ended, clock = threading.Event(), TimeLeft()
    with tqdm(total=1, bar_format="{desc} [{elapsed}]", desc="start") as bar:

        def show(text: str, done: float, total: int) -> None:
            clock.count(done)
            bar.total, bar.n, bar.initial = total, done, clock.first
            bar.unit, bar.bar_format = "%" if total == 100 else "step", BAR_WITH_RATE if clock.each else BAR
            bar.set_postfix_str(clock.text(total), refresh=False)
            bar.set_description(shortened(text, shutil.get_terminal_size().columns - BESIDE))

        def tick() -> None:
            while not ended.wait(1.0):  # a stage may take minutes, in which the time goes on
                bar.set_postfix_str(clock.text(bar.total))

        thread = threading.Thread(target=tick, daemon=True)
        thread.start()
        try:
            yield show
        finally:
            ended.set()
            thread.join()


def _report_lines() -> ProgressReport:
    """Return a report that prints a line per stage with the time left, and a line a minute for an unchanged text."""
    clock, begin = TimeLeft(), time.monotonic()
    last = ("", begin)

    def show(text: str, done: float, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        clock.count(done)
        if text == last[0] and done < total and now - last[1] < SILENCE:
            return
        last, left = (text, now), clock.text(total)
        print(f"[{now - begin:6.1f} s] {done:g}/{total} {text}{', ' * bool(left)}{left}", flush=True)

    return show
