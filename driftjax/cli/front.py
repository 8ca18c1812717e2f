"""Front door: picks the verb, and turns every way to end into an exit code.

0 done; 2 bad input (one sentence, no traceback, nothing left behind); 1 failed run (what was computed is kept);
130 and 143 stopped by Ctrl-C or SIGTERM (finished stages are kept). A verb is imported when it is asked for, so
that help comes at once.
"""

import importlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from driftjax import __version__

VERBS = (
    "learn",
    "diagnose",
    "inspect",
    "calibrate",
    "simulate",
    "plan",
    "equilibria",
    "tune",
    "sweep",
    "paper",
    "bench",
    "runs",
    "report",
)
HELP = """usage: driftjax VERB [options]

A differentiable, jit-compiled car in JAX that learns to drift.

  learn          plan, nominal laps, GP laps and active exploration on a batch of plants: table, figures, run folder
  diagnose LOG   what measured logs say the model gets wrong, why, and what mending it gains
  inspect LOG    what is in a measured log, and whether its channels agree
  calibrate LOG  the nominal car fitted to runs in which it should be right, before others are asked
  simulate       drive manoeuvres on a car with any effects and noise: a log in the log format, and the truth beside it
  plan           minimum-time plan of a car on a track: plan.nc, plan.csv, figures
  equilibria     map of a car's steady states: grip and drift branches
  tune           weights and switching lead of the drift MPC by gradients through laps, against random search
  sweep CONFIG   many trials of a verb over its options, on this machine or a cluster; only what is missing runs
  paper          every method of the paper side by side on plants held out, with ablations, on both cars
  bench          how fast each part is, as a ratio against a peer measured beside it: table, JSON, figures
  runs           list the run folders below runs/
  report RUN     rebuild figures, table and report.html of a run

`driftjax VERB --help` lists the options of a verb with their units; `driftjax --version` says the version.
"""


class Terminated(BaseException):
    """SIGTERM arrived."""


def main(argv: list[str] | None = None) -> int:
    """Run one verb; returns the exit code."""
    verb, *rest = (sys.argv[1:] if argv is None else list(argv)) or ["--help"]
    if verb in ("-h", "--help"):
        print(HELP, end="")
        return 0
    if verb == "--version":
        print(f"driftjax {__version__}")
        return 0
    if verb not in VERBS:
        return _told(f"there is no verb '{verb}'; choose one of {', '.join(VERBS)}.", 2)
    from driftjax.core import BadInput

    try:
        with _sigterm_raises():
            return importlib.import_module(f"driftjax.cli.{verb}").run(rest)
    except BadInput as error:
        return _told(str(error), 2, verb)
    except SystemExit as stop:  # tyro's own: 0 after help, 2 after an unknown flag
        return stop.code if isinstance(stop.code, int) else 2
    except BrokenPipeError:  # the reader of a pipe, such as head, went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt as stop:
        return _told(str(stop) or "stopped.", 130, verb)
    except Terminated as stop:
        return _told(str(stop) or "terminated.", 143, verb)


def _told(sentence: str, code: int, verb: str = "") -> int:
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
