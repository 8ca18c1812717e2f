"""Entry point: select the verb and return its exit code.

0 done; 2 bad input (one sentence, no traceback, nothing left behind); 1 failed run (what was computed is kept);
130 and 143 stopped by Ctrl-C or SIGTERM (finished stages are kept). A verb is imported when it runs, so that
help is fast.
"""

import importlib
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from driftjax import __version__

HELP = """usage: driftjax VERB [options]

A differentiable, jit-compiled car in JAX that learns to drift.

  learn          plan, nominal laps, GP laps and active exploration on a batch of plants: table, figures, run folder
  diagnose LOG   name the model errors that measured logs show, and the gain of correcting them
  compare A B    name what differs between two logs of like manoeuvres, and the gap that it makes
  inspect LOG    what is in a measured log, and whether its channels agree
  calibrate LOG  fit the nominal car to runs in which it should be right, before a diagnosis
  simulate       drive manoeuvres on a car with any effects and noise: a log in the log format, and its truth
  export CAR     a car in the format of another tool, and what that format loses of it
  plan           minimum-time plan of a car on a track: plan.nc, plan.csv, figures
  equilibria     map of a car's steady states: grip and drift branches
  tune           weights and switching lead of the drift MPC by gradients through laps, against random search
  sweep CONFIG   many trials of a verb over its options, on this machine or a cluster; only missing ones run
  paper          compare all methods of the paper on held-out plants, with ablations, on both cars
  bench          speed of each part as a ratio against a peer measured in the same run: table, JSON, figures
  runs           list the run folders below runs/
  report RUN     rebuild figures, table and report.html of a run
  play RUN       open report.html in the browser; export the cars as MCAP, GIF or MP4

`driftjax VERB --help` lists the options of a verb with their units; `driftjax --version` says the version.
"""
VERBS = tuple(re.findall(r"^  (\w+)", HELP, re.MULTILINE))


class Terminated(BaseException):
    """Raised on SIGTERM."""


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    verb, *rest = (sys.argv[1:] if argv is None else list(argv)) or ["--help"]
    if verb in ("-h", "--help"):
        print(HELP, end="")
        return 0
    if verb == "--version":
        print(f"driftjax {__version__}")
        return 0
    if verb not in VERBS:
        return _print_error(f"there is no verb '{verb}'; choose one of {', '.join(VERBS)}.", 2)
    from driftjax.core import BadInput

    try:
        with _sigterm_raises():
            return importlib.import_module(f"driftjax.cli.{verb}").run(rest)
    except BadInput as error:
        return _print_error(str(error), 2, verb)
    except SystemExit as stop:  # tyro's own: 0 after help, 2 after an unknown flag
        return stop.code if isinstance(stop.code, int) else 2
    except BrokenPipeError:  # the reader of a pipe, such as head, went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt as stop:
        return _print_error(str(stop) or "stopped.", 130, verb)
    except Terminated as stop:
        return _print_error(str(stop) or "terminated.", 143, verb)


def _print_error(sentence: str, code: int, verb: str = "") -> int:
    print(f"driftjax{' ' * bool(verb)}{verb}: {sentence}", file=sys.stderr)
    return code


@contextmanager
def _sigterm_raises() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
