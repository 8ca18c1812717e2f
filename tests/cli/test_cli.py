"""The command line: exit codes, one sentence for bad input, nothing left behind, runs that stop and go on."""

import os
import signal
import types
from pathlib import Path

import numpy as np
import pytest
import yaml
from report.synthetic import synthetic_plan, synthetic_results, synthetic_stage

from driftjax.cli import main
from driftjax.store import RunFolder

CONFIGS = Path(__file__).parents[2] / "configs"
STAGES = ("nominal", "gpr-1", "explore-1")


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Every test works in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def loop(monkeypatch):
    """The learning loop replaced: made-up stages; `loop.stop` maps a stage to what is raised before it."""
    fake = types.SimpleNamespace(stop={}, configs=[], drawn=[])

    def run(config, folder, report, num_workers):
        fake.configs.append(config)
        for number, name in enumerate(STAGES):
            if name in folder.finished():
                continue
            report(name, number, len(STAGES))
            if name in fake.stop:
                fake.stop[name]()
            fake.drawn.append(name)
            folder.write_dataset("plan.nc", synthetic_plan())
            folder.write_stage(name, synthetic_stage(name, synthetic_plan(), ("path", "paper"), 2, number), b"")
        folder.write_json("results", synthetic_results(folder))
        folder.write_laps()
        return folder.read_json("results")

    monkeypatch.setattr("driftjax.learning.run.run", run)
    monkeypatch.setattr("driftjax.report.learn.learn_figures", lambda run: iter(()))  # tested with the report; slow
    return fake


def written(name: str, text: str) -> str:
    Path(name).write_text(text)
    return name


def vehicle(**changes) -> str:
    shipped = yaml.safe_load((CONFIGS / "vehicle/sedan.yaml").read_text())
    return written("car.yaml", yaml.safe_dump(shipped | changes))


def crossing() -> str:
    t = np.linspace(0, 2 * np.pi, 80, endpoint=False)
    rows = np.stack([60 * np.sin(t), 30 * np.sin(2 * t), 4 + 0 * t, 4 + 0 * t], axis=1)
    np.savetxt("eight.csv", rows, delimiter=",")
    return "eight.csv"


def corner(width: float) -> str:
    shipped = yaml.safe_load((CONFIGS / "track/sedan_corner.yaml").read_text())
    return written("corner.yaml", yaml.safe_dump(shipped | {"width": width}))


def finished_run() -> str:
    RunFolder.create("taken", {"car": "sedan"})
    return "taken"


def needed_logs(*arguments: str) -> tuple[str, ...]:
    """Write the logs that the arguments name."""
    t = np.arange(0, 8, 0.02)
    for name, size in (("a.csv", 0.3), ("b.csv", 0.2)):
        turning = size * np.sin(1.3 * t)
        log = np.stack([t, 12 + np.sin(t), 0.1 * turning, turning, 0.2 * turning, 500 * np.sin(t)], axis=1)
        np.savetxt(name, log, delimiter=",", header="t,V,beta,r,delta,Fxr", comments="")
    return arguments


BAD = {
    "unknown YAML key": (lambda: ["learn", "--config", written("c.yaml", "plnts: 3\n")], "unknown key 'plnts'"),
    "unknown nested YAML key": (lambda: ["learn", "--config", written("c.yaml", "mpc: {horizn: 3}\n")], "'horizn'"),
    "wrong YAML type": (lambda: ["learn", "--config", written("c.yaml", "plants: many\n")], "key 'plants'"),
    "not YAML": (lambda: ["learn", "--config", written("c.yaml", "plants: [1\n")], "not valid YAML"),
    "negative mass": (lambda: ["learn", "--vehicle", vehicle(m=-1835.0)], "key 'm' is -1835.0"),
    "negative mass, plan": (lambda: ["plan", "--vehicle", vehicle(m=-1835.0)], "key 'm' is -1835.0"),
    "negative mass, equilibria": (lambda: ["equilibria", "--vehicle", vehicle(m=-1.0)], "key 'm' is -1.0"),
    "unknown effect": (lambda: ["learn", "--vehicle", vehicle(effects={"magic": {"p": 1}})], "effect 'magic': no such"),
    "unknown effect, plan": (lambda: ["plan", "--vehicle", vehicle(effects={"magic": {"p": 1}})], "'magic': no such"),
    "effect out of bounds, equilibria": (
        lambda: ["equilibria", "--vehicle", vehicle(effects={"friction": {"p": 2.0}})],
        "friction.p is 2.0; the value lies in",
    ),
    "zero horizon": (lambda: ["learn", "--mpc.horizon", "0"], "key 'horizon' is 0"),
    "zero horizon, YAML": (lambda: ["learn", "--config", written("c.yaml", "mpc: {horizon: 0}\n")], "'horizon' is 0"),
    "no plants": (lambda: ["learn", "--plants", "0"], "key 'plants' is 0"),
    "few nodes": (lambda: ["plan", "--num-nodes", "3"], "key 'num_nodes' is 3"),
    "unknown car": (lambda: ["learn", "--car", "tram"], "tram: no such file"),
    "unknown car, plan": (lambda: ["plan", "--car", "tram"], "tram: no such file"),
    "track crosses itself": (lambda: ["learn", "--track", crossing()], "crosses itself"),
    "track crosses itself, plan": (lambda: ["plan", "--track", crossing()], "crosses itself"),
    "narrow track": (lambda: ["learn", "--track", corner(0.8)], "1.6 m wide, but the car is 1.85 m wide"),
    "narrow track, plan": (lambda: ["plan", "--track", corner(0.8)], "but the car is 1.85 m wide"),
    "missing config": (lambda: ["learn", "--config", "absent.yaml"], "absent.yaml: no such file"),
    "missing track": (lambda: ["plan", "--track", "absent.csv"], "absent.csv: no such file"),
    "missing plant": (lambda: ["learn", "--plant", "absent.yaml"], "absent.yaml: no such file"),
    "unwritable output": (lambda: ["learn", "--out", written("file", "mine") + "/run"], "give another folder (--out)"),
    "unwritable output, plan": (
        lambda: ["plan", "--out", written("file", "mine") + "/run"],
        "give another folder (--out)",
    ),
    "taken output": (lambda: ["learn", "--out", finished_run()], "already holds a run; continue it (--resume "),
    "taken output, export": (
        lambda: ["export", "sedan", "--to", "tum", "--out", finished_run()],
        "taken: already holds a run; give another folder (--out)",
    ),
    "resume nothing": (lambda: ["learn", "--resume", "absent"], "absent: holds no run"),
    "resume with flags": (
        lambda: ["learn", "--resume", finished_run(), "--plants", "3"],
        "leave out every flag but --workers",
    ),
    "report on nothing": (lambda: ["report", "absent"], "absent: holds no run"),
}


WITH_OUT = {
    "learn": [], "plan": [], "equilibria": [], "simulate": [], "bench": [], "paper": [], "tune": [],
    "inspect": ["a.csv"], "diagnose": ["a.csv"], "calibrate": ["a.csv"], "compare": ["a.csv", "b.csv"],
    "export": ["sedan", "--to", "tum"], "sweep": [str(CONFIGS / "sweep/weights.yaml")],
}  # fmt: skip
BAD |= {
    f"file as output, {verb}": (
        lambda verb=verb: [verb, *needed_logs(*WITH_OUT[verb]), "--out", written("file", "mine")],
        "file: is a file, not a folder; give another folder (--out)",
    )
    for verb in WITH_OUT
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_and_leaves_nothing(case, here, loop, capsys):
    arguments, words = BAD[case]
    argv = arguments()
    before = {path: path.read_bytes() for path in here.rglob("*") if path.is_file()}
    assert main(argv) == 2
    output = capsys.readouterr()
    lines = output.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].endswith(".") and words in lines[0], output.err
    assert "Traceback" not in output.err + output.out and output.out == ""
    assert {path: path.read_bytes() for path in here.rglob("*") if path.is_file()} == before
    assert not Path("runs").exists() and loop.configs == []


@pytest.mark.parametrize("argv", ["learn --bogus 3", "plan --plants 3", "runs x", "report", "fly"])
def test_what_is_not_understood_exits_2(argv, here, capsys):
    assert main(argv.split()) == 2
    assert "Traceback" not in capsys.readouterr().err and list(here.iterdir()) == []


@pytest.mark.parametrize("argv", ["--help", "--version", "", "learn --help", "plan --help", "equilibria --help"])
def test_help_exits_0(argv, here, capsys):
    assert main(argv.split()) == 0
    assert "driftjax" in capsys.readouterr().out and list(here.iterdir()) == []


def test_bad_input_found_while_running_leaves_nothing(here, loop, capsys):
    from driftjax.core import BadInput

    def bad():
        raise BadInput("the plan has no drift; choose a tighter track.")

    loop.stop["nominal"] = bad
    assert main(["learn", "--out", "a/b"]) == 2
    assert capsys.readouterr().err == "driftjax learn: the plan has no drift; choose a tighter track.\n"
    assert list(here.iterdir()) == []


def test_learn_writes_report_and_table_and_is_listed(here, loop, capsys):
    assert main(["learn", "--plants", "2", "--out", "r"]) == 0
    out = capsys.readouterr().out
    assert "nominal MPC" in out and "Wu et al. 2025" in out and "1 spun" in out
    run = RunFolder.open("r")
    assert run.finished() == list(STAGES) and run.config["plants"] == 2
    assert all(run.has(name) for name in ("report.html", "results.json", "laps.nc", "table.txt", "versions.json"))
    assert main(["runs", "--root", "."]) == 0
    line = capsys.readouterr().out
    assert "sedan" in line and "3 stages" in line and " r" in line
    (here / "r/report.html").unlink()
    assert main(["report", "r"]) == 0
    assert run.has("report.html") and capsys.readouterr().out.splitlines()[2].startswith("nominal MPC")


def test_flags_go_before_yaml_before_the_cars_defaults(here, loop):
    text = "car: rc\nplants: 7\nseed: 5\nmpc: {horizon: 12}\nexplore: {lam: 0.3}\n"
    flags = ["--plants", "2", "--mpc.tolerance", "1e-4", "--out", "r"]
    assert main(["learn", "--config", written("c.yaml", text), *flags]) == 0
    config = loop.configs[0]
    assert (config.car, str(config.vehicle), str(config.track)) == ("rc", "rc", "rc_corner")
    assert (config.plants, config.seed) == (2, 5)
    assert (config.mpc.horizon, config.mpc.tolerance, config.mpc.dt) == (12, 1e-4, 0.02)
    assert (config.explore.lam, config.explore.w1) == (0.3, 90.0)


def test_learn_without_flags_is_the_sedan_on_four_plants(here, loop):
    assert main(["learn"]) == 0
    assert loop.configs[0].car == "sedan" and loop.configs[0].plants == 4
    (made,) = Path("runs").iterdir()
    assert made.name.startswith("learn-sedan-")


def interrupt():
    raise KeyboardInterrupt


def terminate():
    os.kill(os.getpid(), signal.SIGTERM)


def fail():
    raise FloatingPointError("the lap\nbecame non-finite")


@pytest.mark.parametrize(("how", "code"), [(interrupt, 130), (terminate, 143), (fail, 1)])
def test_a_run_that_stops_keeps_its_stages_and_goes_on(how, code, here, loop, capsys):
    before = signal.getsignal(signal.SIGTERM)
    loop.stop["gpr-1"] = how
    assert main(["learn", "--seed", "3", "--out", "r"]) == code
    output = capsys.readouterr().err
    assert len(output.strip().splitlines()) == 1 and "driftjax learn --resume r" in output
    assert signal.getsignal(signal.SIGTERM) is before
    assert RunFolder.open("r").finished() == ["nominal"]
    assert main(["runs", "--root", "."]) == 0 and "stopped after nominal" in capsys.readouterr().out
    assert main(["report", "r"]) == 0
    loop.stop.clear()
    assert main(["learn", "--resume", "r"]) == 0
    assert loop.drawn == list(STAGES)
    assert loop.configs[0] == loop.configs[1] and loop.configs[1].seed == 3


def test_plan_writes_plan_table_and_figures_and_says_whether_to_trust_it(here, capsys):
    assert main(["plan", "--car", "rc", "--no-drift", "--out", "p"]) == 0
    said = capsys.readouterr().out
    data = RunFolder.open("p").read_dataset("plan.nc")
    assert f"lap time {data.attrs['lap_time']:.3f} s" in said and data.attrs["violation"] < 1e-6
    table = np.genfromtxt("p/plan.csv", delimiter=",", skip_header=1)
    np.testing.assert_allclose(table[:, 2], data["V"], rtol=1e-8)
    header = Path("p/plan.csv").read_text().splitlines()[0].split(",")
    assert header[:4] == ["s [m]", "t [s]", "V [m/s]", "beta [rad]"] and len(header) == table.shape[1]
    assert all(Path("p", name).stat().st_size > 10_000 for name in ("plan_trajectory.png", "plan_states.png"))
    assert main(["plan", "--car", "rc", "--no-drift", "--max-steps", "2", "--out", "q"]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1 and Path("q/plan.nc").is_file()
    assert main(["report", "p"]) == 0
