"""Front door: `driftjax learn | plan | equilibria | runs | report`.

Exit codes: 0 done; 2 bad input (one sentence, no traceback, nothing left behind); 1 failed run (what was computed
is kept); 130 and 143 stopped by Ctrl-C or SIGTERM (finished stages are kept). Imports are made where they are
needed, so that help comes at once.
"""

import argparse
import dataclasses
import os
import shlex
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from driftjax.core.errors import BadInput

if TYPE_CHECKING:
    from driftjax.data import RunFolder
    from driftjax.learn.config import LearnConfig

T = TypeVar("T")

HELP = """usage: driftjax VERB [options]

A differentiable, jit-compiled car in JAX that learns to drift.

  learn        plan, nominal laps, GP laps and active exploration on a batch of plants: table, figures, run folder
  plan         minimum-time plan of a car on a track: plan.nc, plan.csv, figure
  equilibria   map of a car's steady states: grip and drift branches
  runs         list the run folders below runs/
  report RUN   rebuild figures, table and report.html of a run

`driftjax VERB --help` lists the options of a verb with their units; `driftjax --version` says the version.
"""


class Terminated(BaseException):
    """SIGTERM arrived."""


def main(argv: list[str] | None = None) -> int:
    """Run one verb; returns the exit code."""
    argv = sys.argv[1:] if argv is None else list(argv)
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(HELP, end="")
        return 0
    if argv[0] in ("-V", "--version", "version"):
        from driftjax import __version__

        print(f"driftjax {__version__}")
        return 0
    verb, *rest = argv
    if verb not in VERBS:
        print(f"driftjax: there is no verb '{verb}'; choose one of {', '.join(VERBS)}.", file=sys.stderr)
        return 2
    try:
        with _sigterm_raises():
            return VERBS[verb](rest)
    except BadInput as error:
        print(f"driftjax {verb}: {error}", file=sys.stderr)
        return 2
    except SystemExit as stop:  # tyro's own: 0 after help, 2 after an unknown flag
        return stop.code if isinstance(stop.code, int) else 2
    except BrokenPipeError:  # the reader of a pipe, such as head, went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        print(f"driftjax {verb}: stopped.", file=sys.stderr)
        return 130
    except Terminated:
        print(f"driftjax {verb}: terminated.", file=sys.stderr)
        return 143


def learn(argv: list[str]) -> int:
    """The paper's experiment, or the rest of one that was stopped."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in ("--car", "--config", "--resume"):
        early.add_argument(flag)
    known, others = early.parse_known_args(argv)
    _set_up_jax()
    from driftjax.core import from_dict
    from driftjax.core.config import to_dict
    from driftjax.data import RunFolder
    from driftjax.learn.config import LearnConfig

    if known.resume and not {"-h", "--help"} & set(others):
        if others or known.car or known.config:
            raise BadInput("--resume goes on with the run's own config; leave out every other flag.")
        folder = RunFolder.open(known.resume)
        config = from_dict(LearnConfig, folder.config, str(folder.path / "config.yaml"))
    else:
        config, out = _learn_options(argv, known.car, known.config)
        folder = RunFolder.create(out or _default_out("learn", config.car), to_dict(config))
    return _work(folder, lambda: _learn(config, folder), f"driftjax learn --resume {shlex.quote(str(folder.path))}")


def _learn_options(argv: list[str], car: str | None, file: str | None) -> "tuple[LearnConfig, Path | None]":
    """Config and output folder: the car's defaults, then the YAML file, then flags."""
    import tyro

    from driftjax.core import from_dict, read_yaml
    from driftjax.core.config import to_dict
    from driftjax.learn.config import LearnConfig, load_learn_config

    written = read_yaml(Path(file)) if file else {}
    base = to_dict(load_learn_config(car or str(written.get("car", "sedan"))))
    defaults = from_dict(LearnConfig, _merged(base, written), file or "defaults")

    @dataclasses.dataclass(frozen=True)
    class Learn:
        """Plan, nominal laps, GP laps and active exploration, on a batch of plants driven side by side."""

        options: Annotated[LearnConfig, tyro.conf.arg(name="")] = defaults
        config: Path | None = None
        """YAML file of options, where they differ from the car's defaults; flags go before it."""
        out: Path | None = None
        """Run folder; runs/learn-CAR-TIME where left out."""
        resume: Path | None = None
        """Run folder to go on with, from its last finished stage and with its own config; no other flags."""

    typed = _typed(Learn, argv, "driftjax learn")
    return typed.options, typed.out


def _learn(config: "LearnConfig", folder: "RunFolder") -> int:
    from driftjax.learn.run import run
    from driftjax.report import table, write_report

    print(f"run folder: {folder.path}", flush=True)
    with _progress() as progress:
        results = run(config, folder, progress)
    folder.write_json("results", results)
    folder.collect()
    page = write_report(folder)
    print(table(folder.read_json("results")))
    print(f"report: {page}")
    return 0


def plan(argv: list[str]) -> int:
    """Minimum-time plan of one car on one track."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--car", default="sedan")
    early.add_argument("--config")
    known, _ = early.parse_known_args(argv)
    _set_up_jax()
    import tyro

    from driftjax.core import from_dict, read_yaml
    from driftjax.core.config import to_dict
    from driftjax.data import RunFolder
    from driftjax.plan import PlanConfig, load_plan_config

    written = read_yaml(Path(known.config)) if known.config else {}
    names = {"vehicle": known.car, "track": f"{known.car}_corner"}
    names |= {key: str(written.pop(key)) for key in tuple(names) if key in written}
    base = to_dict(load_plan_config(known.car)) | written
    defaults = from_dict(PlanConfig, base, known.config or "defaults")

    @dataclasses.dataclass(frozen=True)
    class Plan:
        """Minimum-time plan of a car along a track: plan.nc, plan.csv and a figure."""

        options: Annotated[PlanConfig, tyro.conf.arg(name="")] = defaults
        car: str = known.car
        """Name of the car whose shipped vehicle, track and options are the defaults: sedan or rc."""
        vehicle: Path = Path(names["vehicle"])
        """Nominal car: a shipped name or a vehicle YAML."""
        track: Path = Path(names["track"])
        """Track: a shipped name, a track YAML or a CSV of x,y,w_right,w_left."""
        config: Path | None = None
        """YAML file of options, and vehicle and track, where they differ from the car's defaults."""
        out: Path | None = None
        """Output folder; runs/plan-CAR-TIME where left out."""

    typed = _typed(Plan, argv, "driftjax plan")
    options = {"vehicle": str(typed.vehicle), "track": str(typed.track)} | to_dict(typed.options)
    folder = RunFolder.create(typed.out or _default_out("plan", typed.car), options, "plan")
    return _work(folder, lambda: _plan(typed, folder))


def _plan(typed: Any, folder: "RunFolder") -> int:
    from driftjax.core import RESULTS
    from driftjax.data import plan_dataset, write_plan_csv
    from driftjax.plan import plan as solve
    from driftjax.report import write_plan_figures
    from driftjax.track import load_track
    from driftjax.vehicle import load_vehicle

    vehicle, track = load_vehicle(typed.vehicle), load_track(typed.track)
    print(f"planning {vehicle.name} on {typed.track}", flush=True)
    solved = solve(track, vehicle, typed.options)
    data = plan_dataset(solved, track, vehicle.name)
    folder.write_dataset("plan.nc", data)
    write_plan_csv(folder.path / "plan.csv", data)
    write_plan_figures(data, folder.path)
    done = bool(solved.result == RESULTS.successful)
    print(f"lap time {float(solved.lap_time):.3f} s after {int(solved.num_steps)} iterations", end=", ")
    print(f"KKT residual {float(solved.kkt):.1e}, violation {float(solved.violation):.1e}")
    print("drift " + (", ".join(f"{a:.4g} to {b:.4g} m" for a, b in solved.drift_intervals()) or "nowhere"))
    print(f"plan: {folder.path}")
    if not done:
        print(f"driftjax plan: {RESULTS[solved.result]}", file=sys.stderr)
    return 0 if done else 1


def equilibria(argv: list[str]) -> int:
    """Map of steady states of one car."""
    _set_up_jax()
    import tyro

    from driftjax.core.config import to_dict
    from driftjax.data import RunFolder
    from experiments.equilibria import Config
    from experiments.equilibria import main as draw_map

    @dataclasses.dataclass(frozen=True)
    class Equilibria:
        """Map of a car's steady states over speed and yaw rate."""

        options: Annotated[Config, tyro.conf.arg(name="")] = Config()
        out: Path | None = None
        """Output folder; runs/equilibria-VEHICLE-TIME where left out."""

    typed = _typed(Equilibria, argv, "driftjax equilibria")
    name = Path(typed.options.vehicle).stem
    folder = RunFolder.create(typed.out or _default_out("equilibria", name), to_dict(typed.options), "equilibria")

    def work() -> int:
        results = draw_map(typed.options, folder.path)
        folder.write_json("results", results)
        print("\n".join(f"{name:32s} {value:.6g}" for name, value in results.items()))
        print(f"map: {folder.path / 'equilibria.png'}")
        return 0

    return _work(folder, work)


def runs(argv: list[str]) -> int:
    """List the run folders."""

    @dataclasses.dataclass(frozen=True)
    class Runs:
        """List run folders, oldest first."""

        root: Path = Path("runs")
        """Folder below which to look."""

    typed = _typed(Runs, argv, "driftjax runs")
    from driftjax.data import list_runs
    from driftjax.report import run_line

    found = list_runs(typed.root)
    print("\n".join(map(run_line, found)) if found else f"no runs below {typed.root}")
    return 0


def report(argv: list[str]) -> int:
    """Rebuild the report of one run."""
    import tyro

    @dataclasses.dataclass(frozen=True)
    class Report:
        """Rebuild figures, table and report.html of a run from its folder alone."""

        run: tyro.conf.Positional[Path]
        """Run folder."""

    typed = _typed(Report, argv, "driftjax report")
    _set_up_jax()
    from driftjax.data import RunFolder
    from driftjax.report import table, write_plan_figures, write_report

    folder = RunFolder.open(typed.run)
    if folder.verb == "plan":
        made = write_plan_figures(folder.read_dataset("plan.nc"), folder.path)
        print("\n".join(map(str, made)))
        return 0
    if folder.verb != "learn":
        raise BadInput(f"{folder.path}: a run of `driftjax {folder.verb}` has no report; run that verb again.")
    page = write_report(folder)
    if folder.has("results.json"):
        print(table(folder.read_json("results")))
    print(f"report: {page}")
    return 0


VERBS: dict[str, Callable[[list[str]], int]] = {
    "learn": learn, "plan": plan, "equilibria": equilibria, "runs": runs, "report": report,
}  # fmt: skip


def _typed(cls: type[T], argv: list[str], prog: str) -> T:
    import tyro

    try:
        return tyro.cli(cls, args=argv, prog=prog)
    except BadInput as error:
        raise BadInput(f"flags: {error}") from None


def _merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over` put in, key by key in nested mappings."""
    both = {key: _merged(base[key], value) for key, value in over.items()
            if isinstance(value, dict) and isinstance(base.get(key), dict)}  # fmt: skip
    return base | over | both


def _default_out(verb: str, name: str) -> Path:
    return Path("runs") / f"{verb}-{name}-{time.strftime('%Y%m%d-%H%M%S')}"


def _set_up_jax() -> None:
    """Double precision and a compilation cache that outlives the process."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads inside each small batched factorisation cost 10x
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    if jax.config.values["jax_compilation_cache_dir"] is None:  # JAX itself reads JAX_COMPILATION_CACHE_DIR
        jax.config.update("jax_compilation_cache_dir", str(Path.home() / ".cache" / "driftjax"))


def _work(folder: "RunFolder", work: Callable[[], int], resume: str = "") -> int:
    """`work()`, with what is owed to a person when it does not end well."""
    kept = f"what was computed is in {folder.path}" + (f"; continue with: {resume}" if resume else "")
    try:
        return work()
    except BadInput:
        if not folder.finished():
            folder.discard()
        raise
    except (KeyboardInterrupt, Terminated) as stop:
        print(f"driftjax: stopped; {kept}", file=sys.stderr)
        return 130 if isinstance(stop, KeyboardInterrupt) else 143
    except Exception as error:
        (folder.path / "error.txt").write_text(traceback.format_exc(), encoding="utf-8")
        words = " ".join(str(error).split())[:300]
        print(f"driftjax: the run failed ({type(error).__name__}: {words}); see error.txt; {kept}", file=sys.stderr)
        return 1


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


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """`report(text, done, total)`: a bar with an ETA on a terminal, plain lines elsewhere."""
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


if __name__ == "__main__":
    sys.exit(main())
