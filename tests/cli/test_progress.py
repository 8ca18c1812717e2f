"""Progress: a bar with rate and time left in a terminal, a line per stage elsewhere, and what to do next at the end."""

import io
import os
import pty
import types
from pathlib import Path

import numpy as np
import pytest

from driftjax.cli import console
from driftjax.cli.diagnose import STEPS, next_step
from driftjax.diagnosis.diagnose import diagnose
from driftjax.logs import Log, Run
from driftjax.vehicle import load_vehicle


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test sets [s]."""
    clock = types.SimpleNamespace(now=0.0)
    monkeypatch.setattr(console, "time", types.SimpleNamespace(monotonic=lambda: clock.now))
    return clock


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_log_file_has_a_line_per_stage_and_the_time_left(clock, capsys):
    with console.progress() as report:
        for clock.now, done in ((0, 2), (50, 3), (55, 3), (120, 3), (300, 3), (310, 5)):
            report("laps" if done > 2 else "plan", done, 6)
        clock.now = 320
        report("done", 6, 6)
    assert capsys.readouterr().out.splitlines() == [
        "[   0.0 s] 2/6 plan",
        "[  50.0 s] 3/6 laps, 02:30 left",
        "[ 120.0 s] 3/6 laps, 01:20 left",
        "[ 300.0 s] 3/6 laps",  # the estimate was too short
        "[ 320.0 s] 6/6 done",
    ]


def test_what_was_done_once_does_not_count_for_ever_in_the_time_left(clock, capsys):
    with console.progress() as report:
        for clock.now, done in ((0, 0), (270, 1), (272, 2), (282, 3), (292, 4), (302, 5)):
            report(f"lap {done}", done, 17)
    assert capsys.readouterr().out.splitlines()[-1] == "[ 302.0 s] 5/17 lap 5, 01:36 left"  # 12 laps of 8 s


def bars(monkeypatch, *reports: tuple[str, int, int]) -> list[str]:
    """Return what a terminal is shown for these reports, the last bar at the end; nothing goes to stdout."""
    out, err = Terminal(), Terminal()
    monkeypatch.setattr("sys.stdout", out)
    monkeypatch.setattr("sys.stderr", err)
    with console.progress() as report:
        for one in reports:
            report(*one)
    assert out.getvalue() == ""
    return err.getvalue().strip().split("\r")


def test_a_terminal_has_a_bar_with_rate_and_time_left(monkeypatch):
    shown = bars(monkeypatch, ("plan", 0, 4), ("nominal", 3, 4))
    last = shown[-1]
    assert last.startswith("nominal:  75%")
    assert "3/4" in last and " left" in last and ("step/s" in last or "s/step" in last)
    text = "\r".join(shown)
    assert "?" not in text and "0/1" not in text  # no rate, nor a count, that is not known yet


def test_a_long_text_leaves_room_for_the_bar(monkeypatch):
    last = bars(monkeypatch, ("noise and nominal car: compile roll-outs and derivatives", 25, 100))[-1]
    assert last.startswith("noise and nominal car") and "...:" in last and "25%|" in last and "25/100" in last
    assert console.shortened("naming: steer_lag", 25) == "naming: steer_lag"


def test_a_pipe_gets_lines_though_errors_go_to_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr", Terminal())
    with console.progress() as report:
        report("plan", 0, 4)
    assert "0/4 plan" in capsys.readouterr().out


def test_a_terminal_without_a_width_gets_lines(monkeypatch, capsys):
    leader, follower = pty.openpty()  # of 0 columns, until someone says how many
    with os.fdopen(follower, "w") as stream:
        assert stream.isatty() and not console.has_width(stream)
        monkeypatch.setattr("sys.stderr", stream)
        with console.progress() as report:
            report("plan", 0, 4)
    os.close(leader)
    assert "0/4 plan" in capsys.readouterr().out


def test_parts_of_a_step_count(clock, capsys):
    with console.progress() as report:
        for clock.now, text, done in ((0, "rc/main: plan", 0), (10, "rc/main: nominal", 0.25)):
            report(text, done, 2)
    assert capsys.readouterr().out.splitlines()[-1] == "[  10.0 s] 0.25/2 rc/main: nominal, 01:10 left"


def test_steps_count_by_their_usual_time(clock, capsys):
    with console.progress() as report:
        step = console.by_steps(report, {"noise": 10, "naming": 85, "show": 5, "done": 0})
        for clock.now, text in (
            (0, "noise"),
            (100, "naming"),
            (200, "naming: steer_lag"),
            (900, "show"),
            (950, "done"),
        ):
            step(text)
    assert capsys.readouterr().out.splitlines() == [
        "[   0.0 s] 0/100 noise",
        "[ 100.0 s] 10/100 naming, 15:00 left",
        "[ 200.0 s] 10/100 naming: steer_lag, 13:20 left",
        "[ 900.0 s] 95/100 show, 00:47 left",
        "[ 950.0 s] 100/100 done",
    ]


def test_every_step_of_a_diagnosis_is_one_that_the_verb_counts(monkeypatch):
    t, zero, steps = 0.01 * np.arange(2000), np.zeros(2000), []
    r = np.random.default_rng(0).normal(0.0, 0.01, 2000)
    r[500] = 1.0  # an outlier
    run = Run("one", t, 10.0 + zero, zero, r, zero, zero, 0.01)

    def stop(*args):
        raise InterruptedError

    monkeypatch.setattr("driftjax.diagnosis.diagnose.initial_problem", stop)
    with pytest.raises(InterruptedError):
        diagnose(load_vehicle("sedan"), Log((run,)), report=steps.append)
    assert any("outliers left out" in step for step in steps) and any("compile" in step for step in steps)
    assert {step.partition(":")[0] for step in steps} <= set(STEPS)


def test_a_diagnosis_says_what_to_do_next():
    def said(evidence=True, manoeuvre=None, causes=()):
        proposal = manoeuvre and types.SimpleNamespace(manoeuvre=manoeuvre, duration=10.0)
        made = types.SimpleNamespace(evidence=evidence or None, proposal=proposal, causes=causes)
        return next_step(made, Path("runs/my car"))  # pyright: ignore[reportArgumentType]

    assert "longer log" in said(evidence=False)
    assert "drive `slalom` for 10 s" in said(manoeuvre="slalom")
    assert "`driftjax play 'runs/my car'`" in said() and "extended.yaml" not in said()
    assert "extended.yaml" in said(causes=("steer_lag",))


def test_notes_that_say_the_same_of_several_runs_are_printed_once(capsys):
    console.print_notes(
        [*(f"log.csv, run '{i}': has no beta; it is inferred." for i in range(4)), "log.csv: was thinned."]
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines == [
        "note: log.csv, run '0': has no beta; it is inferred. The same holds for 3 more.", "note: log.csv: was thinned."
    ]  # fmt: skip
