"""The independent plant: nominal where nothing is hidden, lawful, each effect alive; how diagnoses of it are scored."""

import ast
import csv
import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import driftjax as dj
from driftjax.core import Control, State, rk4_step
from driftjax.vehicle.effect import EFFECTS, Place
from driftjax.vehicle.effect.flow import Aux
from driftjax.vehicle.universal import universal_car
from experiments import independent_study
from experiments.independent import car as plant_file
from experiments.independent.car import PARAMETERS, VX, VY, Car, G, R, Strengths
from experiments.independent.cases import (
    COUNTS,
    OF_SENSORS,
    Case,
    draw_alarm,
    draw_case,
    hidden_parameters,
    size_of,
)
from experiments.independent.driver import CAMPAIGN, MANOEUVRES, Limits, rates_of, steady_drift
from experiments.independent.record import Actuation, Sensors, coloured, gaps, record, write_csv
from experiments.independent.score import alarm_table, match, score, table

FOLDER = Path(plant_file.__file__).parent
QUIET = Sensors(noise=0.0, gusts=0.0, further=True)
VEHICLE = {name: dj.load_vehicle(name) for name in ("sedan", "rc")}


def limits(name: str) -> Limits:
    return Limits(*VEHICLE[name].command_limits())


def states(name: str, num: int = 40) -> tuple[Car, np.ndarray, np.ndarray]:
    """Random motions from grip to slide with commands (2, num), of the nominal car."""
    car, rng = Car(size_of(VEHICLE[name]), {}), np.random.default_rng(1)
    V = car.size.unit_speed * rng.uniform(1, 4, num)
    beta, r = rng.uniform(-0.6, 0.6, num), rng.uniform(-0.4, 0.4, num) / car.size.unit_time
    command = np.stack([rng.uniform(-0.4, 0.4, num), car.size.m * G * rng.uniform(-0.2, 0.35, num)])
    return car, np.stack([V, beta, r]), command


def test_the_files_of_the_plant_import_nothing_of_the_package():
    for path in (FOLDER / f"{stem}.py" for stem in ("car", "driver", "record")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [one for one in modules if one.split(".")[0] in ("driftjax", "jax", "scipy")], path


@pytest.mark.parametrize("name", VEHICLE)
def test_with_nothing_hidden_its_rates_are_those_of_the_nominal_car(name):
    car, motion, command = states(name)
    own = np.stack([rates_of(car, *one) for one in zip(motion.T, command.T, strict=True)], 1)
    nominal = VEHICLE[name].build()(State(*map(jnp.asarray, motion)), Control(*map(jnp.asarray, command)))
    assert own == pytest.approx(np.stack(nominal), rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("name", VEHICLE)
def test_its_track_width_does_what_the_effect_of_that_name_does(name):
    """The lateral forces and the moment of four wheels in their own directions, at a track of half the wheelbase."""
    car, motion, command = states(name)
    wide = Car(car.size._replace(track=car.L / 2), {}, 1.0)
    there = [one.forces(one.at(motion, command), *command) for one in (wide, car)]
    model = universal_car(VEHICLE[name], (EFFECTS["track_width"],)).with_parameters(1 / jnp.asarray([0.5]))
    still, at = (
        [jnp.zeros(motion.shape[1])] * 4,
        (State(*map(jnp.asarray, motion)), Control(*map(jnp.asarray, command))),
    )
    rise = np.stack(model.rates(*at, Place(*still), Aux(jnp.zeros((2, len(still[0]))), still[0]))) - np.stack(
        VEHICLE[name].build()(*at)
    )
    (ax, ay, moment), (V, beta, _) = (
        (getattr(there[0], of) - getattr(there[1], of) for of in ("ax", "ay", "moment")),
        motion,
    )
    assert rise[2] == pytest.approx(moment / car.Iz, rel=1e-9, abs=1e-9) and np.abs(rise[2]).max() > 0.01
    assert rise[0] == pytest.approx(ax * np.cos(beta) + ay * np.sin(beta), rel=1e-9, abs=1e-9)
    assert V * rise[1] == pytest.approx(ay * np.cos(beta) - ax * np.sin(beta), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("name", VEHICLE)
def test_with_nothing_hidden_it_drives_as_the_nominal_car_to_the_accuracy_of_the_integrator(name):
    """From every sample of every manoeuvre to the next, against Runge-Kutta steps of the nominal car: a drift left to
    itself longer would show how unstable it is. The yaw of the RC car settles in 10 ms, that of the sedan in 100 ms."""
    size, nominal = size_of(VEHICLE[name]), VEHICLE[name].build()
    runs = record(Car(size, {}), limits(name), tuple(MANOEUVRES), QUIET, seed=3, duration=1.0)
    x = np.stack([[run[column] for column in ("V", "beta", "r")] for run in runs.values()], 1)
    command = np.stack([[run[column] for column in ("delta", "Fxr")] for run in runs.values()], 1)[..., :-1]
    u, ahead = Control(*map(jnp.asarray, command)), State(*map(jnp.asarray, x[..., :-1]))
    for _ in range(4):
        ahead = rk4_step(lambda z: nominal(z, u), ahead, 0.0025)
    unit = np.array([size.unit_speed, 1.0, 1 / size.unit_time])[:, None, None]
    assert len(runs) == len(MANOEUVRES) and (np.abs(np.diff(x)) / unit).max() > 1e-2
    assert (np.abs(x[..., 1:] - np.stack(ahead)) / unit).max() < {"sedan": 1e-6, "rc": 5e-5}[name]


def test_heuns_rule_is_of_second_order():
    car, motion, command = states("sedan", 5)
    car = Car(car.size, {"steer_lag": {"tau": 0.1}, "relaxation_length": {"sigma": 0.4}}, 1.0)
    ends = []
    for h in (4e-3, 2e-3, 1e-3):
        z = car.at(motion, command)
        for _ in range(round(0.2 / h)):
            z, _ = car.step(z, command[0] + 0.05, command[1], np.zeros((3, 5)), h)
        ends.append(z[[VX, VY, R]])
    ratio = np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max()
    assert 3.0 < ratio < 5.5


@pytest.mark.parametrize("name", VEHICLE)
def test_tyres_keep_within_their_friction_and_a_coasting_car_loses_energy(name):
    car, motion, command = states(name)
    hidden = {"load_transfer_lat": {"k_f": 0.05, "k_r": 0.05}, "load_transfer_long": {"h": 0.2 * car.L}}
    hidden |= {"combined_slip": {"p": 1.0}, "rolling_resistance": {"f": 0.02}, "aero_drag": {"c": 0.001 * car.m}}
    car = Car(car.size, hidden, 1.0)
    z = car.at(motion, command)
    z[8], z[10] = 0.8 * G, 0.3 * G
    force = car.forces(z, command[0], 0 * command[1])
    assert (np.abs(force.Fy) <= force.mu * force.Fz * (1 + 1e-12)).all() and (force.Fz > 0).all()
    power = car.m * (force.ax * z[VX] + force.ay * z[VY]) + force.moment * z[R]
    assert (power < 0).all()
    driven = car.forces(z, command[0], 0.3 * command[1])
    used = (driven.Fx / (driven.mu * driven.Fz)) ** 2 + (driven.Fy / (driven.mu * driven.Fz)) ** 2
    assert used.max() < 1.05  # rolling resistance comes on top of the circle


def test_wheel_loads_add_up_and_lateral_transfer_costs_what_the_catalogue_says():
    """An axle loses k (a_y/g)^2 of its grip; the loads sum to the weight."""
    size = size_of(VEHICLE["sedan"])
    car = Car(size, {"load_transfer_lat": {"k_f": 0.06, "k_r": 0.03}, "load_transfer_long": {"h": 0.5}})
    z = car.at(np.array([[15.0], [0.0], [0.6]]), np.zeros((2, 1)))
    z[8], z[10] = 0.9 * G, -0.4 * G
    force = car.forces(z, np.zeros(1), np.zeros(1))
    assert force.Fz.sum() == pytest.approx(size.m * G)
    grip, load = (one.reshape(2, 2).sum(axis=1) for one in (force.mu * force.Fz, force.Fz))
    assert grip / load == pytest.approx(size.mu * (1 - np.array([0.06, 0.03]) * 0.81))
    assert force.Fz[1] > force.Fz[0]
    assert load[0] - car.static[:2].sum() == pytest.approx(0.5 * size.m * 0.4 * G / car.L)


def test_body_roll_and_pitch_swing_towards_the_acceleration():
    car = Car(size_of(VEHICLE["sedan"]), {"load_transfer_long": {"h": 0.5}})
    z = car.at(np.array([[15.0], [0.0], [0.0]]), np.zeros((2, 1)))
    push, seen = np.array([4000.0]), []
    for _ in range(1500):
        z, force = car.step(z, np.zeros(1), push, np.zeros((3, 1)), 2e-3)
        seen.append((z[10, 0], force[0, 0]))
    dive, ax = np.array(seen).T
    assert dive.max() > 1.1 * ax[-1] and dive[-1] == pytest.approx(ax[-1], rel=0.01)


ELSEWHERE = ("steer_delay", "steer_backlash", *OF_SENSORS)  # between command and car, and in the sensors: see below


@pytest.mark.parametrize("name", [name for name in PARAMETERS if name not in ELSEWHERE])
def test_every_hidden_effect_changes_the_motion(name):
    vehicle = VEHICLE["sedan"]
    values = {p.name: 1.5 * p.scale(vehicle) for p in hidden_parameters(name)}
    rates = []
    for hidden in ({name: values}, {}):
        car = Car(size_of(vehicle), hidden)
        z = car.at(np.array([[16.0], [-0.4], [0.7]]), np.array([[-0.05], [3000.0]]))
        z[8], z[10] = 0.8 * G, 0.2 * G
        rates.append(
            car.rates(z, np.full(1, -0.2), np.full(1, 5000.0), np.zeros((3, 1)))[0][[VX, VY, R, *range(12, 16)]]
        )
    assert np.abs(rates[0] - rates[1]).max() > 1e-2


def test_the_plant_hides_only_effects_of_the_catalogue_and_refuses_others():
    further = {name: {p.name for p in EFFECTS[name].parameters} - set(PARAMETERS[name]) for name in PARAMETERS}
    assert {name: more for name, more in further.items() if more} == {"load_transfer_lat": {"h_f"}}
    assert all(PARAMETERS[name] == tuple(p.name for p in hidden_parameters(name)) for name in PARAMETERS)
    with pytest.raises(ValueError, match="rocket"):
        Strengths({"rocket": {"p": 1.0}})
    with pytest.raises(ValueError, match="'q'"):
        Strengths({"friction": {"q": 1.0}})


def test_steering_is_late_by_its_delay_and_has_play():
    size = size_of(VEHICLE["sedan"])
    gear = Actuation(Car(size, {"steer_delay": {"d": 0.005}, "steer_backlash": {"w": 0.01}}), np.zeros(1), 1e-3)
    out = [gear(np.array([command]))[0] for command in (*np.full(8, 0.05), *np.full(7, 0.045))]
    assert out[:5] == [0.0] * 5 and out[5:13] == pytest.approx([0.04] * 8) and out[13:] == pytest.approx([0.04] * 2)


@pytest.mark.parametrize("name", VEHICLE)
def test_a_steady_drift_is_steady(name):
    size = size_of(VEHICLE[name])
    motion, command = steady_drift(size, -0.45, 6 * (size.a + size.b))
    assert np.abs(rates_of(Car(size, {}), motion, command)).max() < 1e-6 * G
    with pytest.raises(ValueError, match="no drift"):
        steady_drift(size, -1.45, 6 * (size.a + size.b))


@pytest.mark.parametrize("name", VEHICLE)
def test_drifts_are_held_with_effects_and_noise(name):
    hidden = {"friction": {"p": -0.06}, "steer_lag": {"tau": 0.05 * Car(size_of(VEHICLE[name]), {}).size.unit_time}}
    runs = record(Car(size_of(VEHICLE[name]), hidden, 1.0), limits(name), ("drift",) * 4, Sensors(), 5, duration=3.0)
    assert len(runs) == 4
    assert np.mean([np.abs(run["beta"][-100:]).mean() > 0.15 for run in runs.values()]) >= 0.5


def test_sensors_are_off_late_and_away_from_the_centre():
    size, hidden = (
        size_of(VEHICLE["sedan"]),
        {"gyro_bias": {"p": 0.02}, "gyro_scale": {"p": 0.1}, "speed_scale": {"p": 0.02}},
    )
    hidden |= {"channel_delay": {"d_V": 0.0, "d_beta": 0.05, "d_r": 0.0}, "imu_lever_arm": {"l_x": 0.5, "l_y": 0.0}}
    run = lambda hidden: next(iter(record(Car(size, hidden), limits("sedan"), ("chirp",), QUIET, 0, 1.0).values()))
    true, off = run({}), run(hidden)  # the driver feels the motion itself, so that both drive the same
    assert off["r"] == pytest.approx(1.1 * true["r"] + 0.02)
    vx, vy = true["V"] * np.cos(true["beta"]), true["V"] * np.sin(true["beta"]) + 0.5 * true["r"]
    assert off["V"] == pytest.approx(1.02 * np.hypot(vx, vy))
    assert off["beta"][5:] == pytest.approx(np.arctan2(vy, vx)[:-5])


def test_noise_has_the_size_and_memory_that_it_should():
    noise = coloured(np.random.default_rng(0), (20_000, 3), 20.0)
    assert noise.std() == pytest.approx(1, abs=0.1)
    assert np.mean(noise[20:] * noise[:-20]) == pytest.approx(np.exp(-1), abs=0.1)
    assert coloured(np.random.default_rng(0), (5000,), 0.0).std() == pytest.approx(1, abs=0.05)


def test_gaps_are_written_as_empty_cells_that_the_package_reads(tmp_path):
    sensors = Sensors(dropouts=0.1)
    runs = record(Car(size_of(VEHICLE["rc"]), {}), limits("rc"), ("chirp", "slalom"), sensors, 1, duration=2.0)
    write_csv(tmp_path / "log.csv", runs)
    with (tmp_path / "log.csv").open() as stream:
        header, *rows = csv.reader(stream)
    assert header == ["t", "V", "beta", "r", "delta", "Fxr", "x", "y", "psi", "ax", "ay", "run"]
    log = dj.read_log(tmp_path / "log.csv")
    assert [run.name for run in log.runs] == ["chirp-1", "slalom-2"] and log.rows == len(rows) == 400
    for run in log.runs:
        assert 0.1 <= np.isnan(run.V).mean() < 0.2 and (np.isnan(run.V) == np.isnan(run.beta)).all()
        assert run.V == pytest.approx(runs[run.name]["V"], nan_ok=True)
    assert gaps(np.random.default_rng(0), 100, 0.0).sum() == 0


def cause(effect: str, rivals: tuple[str, ...] = (), value: float = 0.0) -> dict:
    parameters = {
        p: {"value": value, "ci95": [value - 0.01, value + 0.01], "unit": "1"} for p in PARAMETERS.get(effect, ())
    }
    return {"effect": effect, "rivals": dict.fromkeys(rivals, 0.2), "probability": 0.6, "parameters": parameters,
            "exploratory": False}  # fmt: skip


def result(hidden: dict, causes: list, verdict: str = "NAMED", number: int = 0, body: float = 1.0) -> dict:
    case = {"number": number, "car": "rc", "hidden": hidden, "body": body, "manoeuvres": ["drift"]}
    return {"case": case, "causes": causes, "verdict": verdict, "seconds": 9.0, "explained": {"share": 0.9}}


def test_an_effect_is_found_by_name_or_in_a_small_set_once():
    hidden = {"mass": {"p": 0.05}, "steer_lag": {"tau": 0.03}}
    small, large = cause("drive_gain", ("mass",)), cause("drive_gain", ("mass", "aero_drag", "road_grade"))
    assert match([small, cause("steer_lag")], list(hidden)) == {"drive_gain": "mass", "steer_lag": "steer_lag"}
    assert match([large], list(hidden)) == {}
    both = score(result(hidden, [cause("mass", value=0.05), small, cause("steer_lag", value=0.1)]))
    assert both["false"] == ["drive_gain"] and both["missed"] == [] and both["first"]
    assert both["covered"] == {"mass.p": True, "steer_lag.tau": False}
    assert both["families_false"] == ["drive and brake"] and both["physics"] == ["mass", "drive_gain", "steer_lag"]
    wide = [cause("track_width")]
    assert score(result({}, wide))["false"] == [] and score(result({}, wide, body=0.0))["false"] == ["track_width"]
    tentative = score(result(hidden, [cause("steer_lag"), cause("drive_lag") | {"exploratory": True}]))
    assert tentative["false"] == [] and tentative["false_exploratory"] == ["drive_lag"]
    assert tentative["physics"] == ["steer_lag"] and tentative["physics_exploratory"] == ["drive_lag"]
    family = score(result(hidden, [cause("yaw_inertia"), cause("gyro_bias")]))
    assert family["families_found"] == ["chassis"] and family["families_missed"] == ["steering"]
    assert family["false"] == ["yaw_inertia", "gyro_bias"] and family["families_false"] == ["sensor"]
    assert family["physics"] == ["yaw_inertia"] and not family["first"]


def test_tables_count_right_wrong_and_failed_cases():
    good = result({"mass": {"p": 0.05}}, [cause("mass", value=0.05)])
    missed = result({"mass": {"p": 0.05}}, [], "NOTHING", 1)
    nothing = result({}, [cause("gyro_bias")], "NAMED", 2)
    failed = {"case": good["case"], "error": "Traceback\nValueError: no"}
    rows = {row.split(" | ")[0].strip("| "): row for row in table([good, missed, nothing, failed]).splitlines()}
    assert rows["one"].split(" | ")[2:10] == ["2", "1/2", "1/2", "1/2", "1/2", "1/2", "2/2", "2/2"]
    assert rows["nothing"].split(" | ")[8:12] == ["0/1", "0/1", "-", "0/1"]
    assert "1 of 4 cases failed" in table([good, missed, nothing, failed])
    alarms = [nothing, result({"gyro_bias": {"p": 0.1}}, [cause("gyro_bias"), cause("mass")])]
    assert alarm_table(alarms).startswith(
        "Of 2 logs in which only sensors err 1 name physics, 0 as exploratory, and 2 anything false; 1 of 1"
    )


def test_cases_are_drawn_from_their_seed_and_number():
    first = [draw_case(7, i) for i in range(40)]
    assert first == [draw_case(7, i) for i in range(40)] and first[0] != draw_case(8, 0)
    assert [len(case.hidden) for case in first[::2]] == [*COUNTS, *COUNTS] and {c.car for c in first} == {"sedan", "rc"}
    assert all(set(case.manoeuvres) <= set(CAMPAIGN) and len(case.manoeuvres) in (6, 12) for case in first)
    for case in first:
        for name, values in case.hidden.items():
            bounds = [p.bounds(VEHICLE[case.car]) for p in hidden_parameters(name)]
            assert all(low <= v <= high for v, (low, high) in zip(values.values(), bounds, strict=True)), name
    assert all(score(result(draw_alarm(7, i).hidden, []))["families_missed"] in
               ([], ["sensor"], ["time base"], ["sensor", "time base"]) for i in range(20))  # fmt: skip


def test_a_study_that_was_stopped_goes_on_and_keeps_failures(tmp_path, capsys):
    cases, tried = [draw_case(3, i) for i in range(3)], []

    def run(case: Case) -> dict:
        tried.append(case.number)
        if case.number == 1:
            raise RuntimeError("lost")
        return {"case": dataclasses.asdict(case)} | {k: v for k, v in result({}, []).items() if k != "case"}

    path = tmp_path / "results.jsonl"
    independent_study.run_all(cases[:2], path, run)
    results = independent_study.run_all(cases, path, run)
    assert tried == [0, 1, 2] and [one["case"]["number"] for one in results] == [0, 1, 2]
    assert "lost" in results[1]["error"] and "failed: RuntimeError: lost" in capsys.readouterr().err
    assert [json.loads(row)["case"]["number"] for row in path.read_text().splitlines()] == [0, 1, 2]
    with pytest.raises(dj.BadInput, match="other cases"):
        independent_study.run_all([draw_case(4, 0)], path, run)
