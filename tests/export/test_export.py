"""Files for other tools: read by their own code where it can be installed, else as that code reads them."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import casadi as ca
import jax
import numpy as np
import pytest
import yaml
from vehiclemodels.utils.tire_model import formula_lateral, formula_lateral_comb, formula_longitudinal
from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st
from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std
from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

from driftjax.cli import main
from driftjax.core import BadInput
from driftjax.export import FORMATS, export_car
from driftjax.export.casadi_car import CasadiModel, rates_model, step_model, substeps
from driftjax.export.loss import loss
from driftjax.export.target import TargetOptions, car_with, restrict_effects
from driftjax.logs import Log, Run, write_log
from driftjax.sim.rollout import actuator_response
from driftjax.vehicle import EffectParameterValue, VehicleConfig, load_vehicle, write_vehicle
from driftjax.vehicle.effect import EFFECTS
from driftjax.vehicle.single_track import G

SEDAN = load_vehicle("sedan")
L = SEDAN.a + SEDAN.b


def with_effects(vehicle: VehicleConfig = SEDAN, **values: float) -> VehicleConfig:
    """The car with effects written as effect__parameter=value."""
    effects = [EffectParameterValue(name.split("__")[0], name.split("__")[1], value) for name, value in values.items()]
    order = list(EFFECTS)
    return dataclasses.replace(vehicle, effects=tuple(sorted(effects, key=lambda one: order.index(one.effect))))


def read_parameters(folder) -> Any:
    """Parameters as CommonRoad's package reads them."""
    return setup_vehicle_parameters(5, folder)


def written(car: VehicleConfig, to: str, folder) -> str:
    """Content of the first file of a format, without measuring the loss, whose program takes seconds to compile."""
    export = FORMATS[to]
    return (folder / export.write(restrict_effects(car, export.holds, TargetOptions()), folder)[0]).read_text()


def test_commonroad_reads_the_files_and_its_tyre_has_our_force(tmp_path):
    car = with_effects(
        dataclasses.replace(SEDAN, combined_slip=1.0), friction__p=-0.1, mass__p=0.05, load_transfer_long__h=0.5
    )
    export_car(car, "commonroad", tmp_path)
    p = read_parameters(tmp_path)
    assert p.m == pytest.approx(1.05 * SEDAN.m)
    assert (p.a, p.b, p.h_s) == (SEDAN.a, SEDAN.b, 0.5)
    Fz = 4000.0
    for alpha in (-0.4, -0.02, 0.1, 0.3):
        force = -0.9 * SEDAN.mu * Fz * np.sin(SEDAN.C * np.arctan(SEDAN.B * alpha))
        assert formula_lateral(alpha, 0.0, Fz, p.tire)[0] == pytest.approx(force, rel=1e-12)
    for kappa in (-0.02, -0.05, -0.1):  # their slip is negative when driving
        drive = formula_longitudinal(kappa, 0.0, Fz, p.tire) / (0.9 * SEDAN.mu * Fz)
        left = formula_lateral_comb(kappa, 0.1, 0.0, 0.9, Fz, 1.0, p.tire)
        assert left == pytest.approx(np.sqrt(max(1 - drive**2, 0.04)), abs=0.06)
    assert np.all(np.isfinite(vehicle_dynamics_std([0, 0, 0.05, 15, 0, 0.3, 0.0, 48, 48], [0.0, 1.0], p)))


def test_the_documented_call_reads_the_files_of_commonroad(tmp_path):
    page = (Path(__file__).parents[2] / "docs/how-to/export.md").read_text(encoding="utf-8")
    (call,) = re.findall(r"`(setup_vehicle_parameters\(.*?\))` of", page)
    export_car(SEDAN, "commonroad", tmp_path)
    names = {"Path": Path, "folder": str(tmp_path), "setup_vehicle_parameters": setup_vehicle_parameters}
    assert eval(call, names).m == SEDAN.m


def test_single_track_of_f1tenth_gym_and_commonroad_turns_as_ours_at_small_slip(tmp_path):
    rc = with_effects(load_vehicle("rc"), stiffness_front__p=0.2)
    export_car(rc, "f1tenth_gym", tmp_path)
    q = yaml.safe_load((tmp_path / "f1tenth_gym.yaml").read_text())
    plain = dataclasses.replace(rc, effects=())
    export_car(plain, "commonroad", tmp_path)
    p = read_parameters(tmp_path)
    assert q["C_Sf"] == pytest.approx(-1.2 * p.tire.p_ky1 / p.tire.p_dy1)
    assert q["C_Sr"] == pytest.approx(-p.tire.p_ky1 / p.tire.p_dy1)
    names = "mu lf lr h m I s_min s_max sv_min sv_max v_switch a_max v_min v_max width length C_Sf C_Sr"
    assert set(q) == set(names.split())
    V, beta, r, delta = 3.0, 0.002, 0.01, 0.003
    theirs = vehicle_dynamics_st([0, 0, delta, V, 0, r, beta], [0.0, 0.0], p)
    ours = rates_model(plain)
    dV, dbeta, dr = np.asarray(jax.jit(ours.function)(np.array([V, beta, r]), np.array([delta, 0.0])))
    assert theirs[5] == pytest.approx(dr, rel=0.01)
    assert theirs[6] == pytest.approx(dbeta, rel=0.01)


def test_race_stack_tyres_and_table_have_the_linear_limit(tmp_path):
    export = export_car(with_effects(steer_lag__tau=0.05), "race_stack", tmp_path)
    assert export.lost == () and export.loss is None
    model = yaml.safe_load((tmp_path / "sedan_pacejka.yaml").read_text())
    assert model["C_Pf"] == pytest.approx([SEDAN.B, SEDAN.C, SEDAN.mu, 0.0])
    assert model["tau_steer"] == 0.05
    table = np.loadtxt(tmp_path / "sedan_pacejka_lookup_table.csv", delimiter=",")
    V, delta, ay = table[0, 1:], table[1:, 0], table[1:, 1:]
    linear = V**2 * delta[1] / L  # tyres alike in front and rear: neutral steering
    slow = linear < 1.0
    assert ay[1, slow] == pytest.approx(linear[slow], rel=0.01)
    for column in ay.T:
        known = column[np.isfinite(column)]
        assert np.all(np.diff(known) > 0) and np.isnan(column[len(known) :]).all()
    assert 0.85 * SEDAN.mu * G < np.nanmax(ay) <= SEDAN.mu * G * 1.001


def test_rows_of_the_steering_table_are_close_enough_for_a_reader_that_takes_the_nearest(tmp_path):
    export_car(load_vehicle("rc"), "race_stack", tmp_path)
    table = np.loadtxt(tmp_path / "rc_pacejka_lookup_table.csv", delimiter=",")
    assert np.diff(table[0, 1:]).max() <= 0.1  # the step of the stack's own tables [m/s]
    for column in table[1:, 1::9].T:
        known = column[np.isfinite(column)]
        for wanted in known[-1] * np.array([0.1, 0.3, 0.5, 0.8]):
            assert known[np.argmin(np.abs(known - wanted))] == pytest.approx(wanted, rel=0.08)


def test_race_stack_gets_its_tyres_under_the_names_that_its_controllers_read(tmp_path):
    export_car(with_effects(friction_rear__p=-0.1, stiffness_front__p=0.2), "race_stack", tmp_path)
    tyres = yaml.safe_load((tmp_path / "sedan_pacejka_default.yaml").read_text())
    assert tyres.pop("floor") == "driftjax"
    front = {"Bf": 1.2 * SEDAN.B, "Cf": SEDAN.C, "Df": SEDAN.mu, "Ef": 0.0}
    rear = {"Br": SEDAN.B, "Cr": SEDAN.C, "Dr": 0.9 * SEDAN.mu, "Er": 0.0}
    assert tyres == pytest.approx({"friction_coeff": 1.0} | front | rear)


def test_tum_tables_are_the_limits_of_grip_in_closed_form(tmp_path):
    h = 0.5
    car = with_effects(friction_front__p=-0.08, load_transfer_long__h=h, power_limit__p=1e-5)
    export_car(car, "tum", tmp_path, top_speed=40.0)
    ggv = np.loadtxt(tmp_path / "ggv.csv", comments="#", delimiter=",")
    machine = np.loadtxt(tmp_path / "ax_max_machines.csv", comments="#", delimiter=",")
    assert ggv.shape[1] == 3 and machine.shape[1] == 2 and ggv[-1, 0] == machine[-1, 0] == 40.0
    assert np.all(ggv >= 0) and np.all(ggv[:, 1:] < 50)
    assert ggv[:, 2] == pytest.approx(0.92 * SEDAN.mu * G, rel=1e-3)  # the front slides first
    assert ggv[:, 1] == pytest.approx(SEDAN.mu * G * SEDAN.a / (L + SEDAN.mu * h), rel=0.01)  # brakes at the rear
    load = 1e-5 * machine[:, 0] * SEDAN.Fxr_max
    force = SEDAN.Fxr_max / (1 + 0.4 * load + load**8) ** (1 / 8)
    assert machine[:, 1] == pytest.approx(force / SEDAN.m, rel=1e-5)


def test_the_drag_coefficient_of_the_tum_planner_is_that_of_our_effect():
    """The planner brakes with dragcoeff V^2 / m (trajectory_planning_helpers, calc_vel_profile)."""
    model = rates_model(with_effects(aero_drag__c=0.5))
    dV = np.asarray(jax.jit(model.function)(np.array([20.0, 0.0, 0.0]), np.zeros(2)))[0]
    assert -dV * SEDAN.m / 20.0**2 == pytest.approx(0.5)
    (note,) = (one for one in FORMATS["tum"].notes if "'dragcoeff'" in one)
    assert note == "aero_drag goes into the planner's own 'dragcoeff', which is the value c of this car"


def autoware(car: VehicleConfig, folder, top_speed: float | None = None) -> dict:
    """Parameters of Autoware's simulator."""
    FORMATS["autoware"].write(restrict_effects(car, FORMATS["autoware"].holds, TargetOptions(top_speed)), folder)
    return yaml.safe_load((folder / "simulator_model.param.yaml").read_text())["/**"]["ros__parameters"]


@pytest.mark.parametrize("command", [0.1, -0.1])
def test_autoware_turns_its_wheels_by_command_times_gain_less_bias_as_we_do(tmp_path, command):
    car = with_effects(steer_offset__p=0.02, steer_gain__p=0.05)
    q = autoware(car, tmp_path)
    n = 20
    commands = np.stack([np.full(n, command), np.zeros(n)], axis=1)
    model = car_with(car, ("steer_offset", "steer_gain"))
    wheels = np.asarray(jax.jit(actuator_response)(model, commands, np.full(n, 10.0), 0.02))[-1, 0]
    assert command * q["debug_steer_scaling_factor"] - q["steer_bias"] == pytest.approx(wheels, rel=1e-12)


@pytest.mark.parametrize("gain", [-0.2, 0.3])
def test_autoware_accelerates_at_most_as_we_do(tmp_path, gain):
    q = autoware(with_effects(drive_gain__p=gain), tmp_path, top_speed=40)
    limit = q["vel_rate_lim"]  # of the command before its gain, and of the acceleration
    reached = min(min(SEDAN.Fxr_max / SEDAN.m, limit) * q["debug_acc_scaling_factor"], limit)
    assert reached == pytest.approx((1 + gain) * SEDAN.Fxr_max / SEDAN.m)
    words = ("simulated_frame_id", "origin_frame_id", "vehicle_model_type", "initialize_source")
    whole = {name for name, value in q.items() if not isinstance(value, float)}
    assert whole == {*words, "timer_sampling_time_ms", "add_measurement_noise"}  # ROS takes no integer for a float


def test_autoware_and_open_car_dynamics_have_our_actuators_and_body(tmp_path):
    car = with_effects(friction_front__p=-0.08, stiffness_rear__p=0.1, steer_delay__d=0.04, steer_lag__tau=0.06,
                       drive_lag__tau=0.1, steer_gain__p=0.05, aero_drag__c=0.5)  # fmt: skip
    q = yaml.safe_load(written(car, "autoware", tmp_path))["/**"]["ros__parameters"]
    assert (q["steer_time_delay"], q["steer_time_constant"], q["acc_time_constant"]) == (0.04, 0.06, 0.1)
    assert q["debug_steer_scaling_factor"] == pytest.approx(1.05) and q["steer_lim"] == SEDAN.delta_max
    content = json.loads(written(car, "open_car_dynamics", tmp_path))
    body = "vehicle_dynamics_single_track"
    drag = content[f"{body}.aerodynamics.c_d"] * content[f"{body}.aerodynamics.air_density_kgpm3"] / 2
    assert drag * content[f"{body}.aerodynamics.A_m2"] == pytest.approx(0.5)
    assert content["steering_actuator.T_PT1"] == 0.06
    assert content[f"{body}.z.tire_model.rear_left.lateral.B"] == pytest.approx(1.1 * SEDAN.B)
    assert content[f"{body}.z.tire_model.front_right.lateral.D"] == pytest.approx(0.92 * SEDAN.mu)


def random_inputs(model, seed: int, num: int = 10):
    """States about the start, moving and slipping, and inputs."""
    rng = np.random.default_rng(seed)
    for _ in range(num):
        x = model.start + rng.uniform(-0.1, 0.1, len(model.start))
        x[:3] = rng.uniform([5.0, -0.5, -1.0], [20.0, 0.5, 1.0])
        yield x, rng.uniform([-0.5, -3000.0], [0.5, 6000.0])


def advance_model(car, dt: float, lap: float = 1000.0) -> CasadiModel:
    """The simulator's step over `dt` [s], as in step.casadi, in JAX."""
    num = substeps(car, dt)
    fine = step_model(car, dt / num, lap)
    return fine._replace(function=lambda x, u: jax.lax.fori_loop(0, num, lambda _, x: fine.function(x, u), x))


def same_as_casadi(car, folder) -> None:
    """Both CasADi functions equal ours to 1e-9."""
    export = FORMATS["casadi"]
    export.write(restrict_effects(car, export.holds, TargetOptions()), folder)
    names = json.loads((folder / "casadi.json").read_text())
    for kind, model in (("rates", rates_model(car)), ("step", advance_model(car, TargetOptions().dt))):
        theirs, ours = ca.Function.load(str(folder / f"{kind}.casadi")), jax.jit(model.function)
        assert names[kind]["x"] == list(model.names) and names[kind]["start"] == model.start.tolist()
        for x, u in random_inputs(model, 1):
            np.testing.assert_allclose(np.asarray(theirs(x, u)).ravel(), ours(x, u), rtol=1e-9, atol=1e-9)


def test_casadi_steps_as_ours(tmp_path):
    same_as_casadi(with_effects(friction_front__p=-0.08, relaxation_length__sigma=0.4, steer_lag__tau=0.05,
                                steer_delay__d=0.05, tyre_curve_rear__p_2=0.3, tyre_curve_rear__p_3=-0.4,
                                tyre_curve_rear__p_4=0.5), tmp_path)  # fmt: skip


@pytest.mark.parametrize("name", ["sedan", "rc"])
def test_casadi_steps_as_ours_without_effects(tmp_path, name):
    same_as_casadi(load_vehicle(name), tmp_path)


@pytest.mark.slow
def test_casadi_steps_as_ours_with_every_effect(tmp_path):
    each = [(e.name, p.name, 0.3 * p.scale(SEDAN)) for e in EFFECTS.values() for p in e.parameters]
    same_as_casadi(dataclasses.replace(SEDAN, effects=tuple(EffectParameterValue(*one) for one in each)), tmp_path)


def test_the_loss_on_a_log_is_that_of_the_lost_effect(tmp_path):
    """The log comes from the exported CasADi step, which integrates by itself."""
    car = with_effects(steer_gain__p=-0.15)
    export = FORMATS["casadi"]
    export.write(restrict_effects(car, export.holds, TargetOptions()), tmp_path)
    step, start = ca.Function.load(str(tmp_path / "step.casadi")), advance_model(car, TargetOptions().dt).start
    dt, num = TargetOptions().dt, 200
    t = np.arange(num) * dt
    delta, x = 0.04 * np.sin(3 * t), [np.concatenate([[14.0], start[1:]])]
    for k in range(num - 1):
        x.append(np.asarray(step(x[-1], [delta[k], 0.0])).ravel())
    V, beta, r = np.array(x)[:, :3].T
    log = Log((Run("one", t, V, beta, r, delta, np.zeros(num), dt),))
    losses = loss(car, dataclasses.replace(car, effects=()), log)
    assert losses.with_them is not None and losses.of == "log"
    assert losses.with_them[2] < 2e-3 < 0.01 < losses.without_them[2]


@pytest.mark.parametrize(("lacks", "words"), [("beta", "sideslip beta"), ("Fxr", "drive force Fxr")])
def test_a_log_without_a_channel_of_the_loss_is_refused(lacks, words, tmp_path, capsys):
    write_vehicle(tmp_path / "car.yaml", with_effects(steer_delay__d=0.05, friction__p=-0.1))
    t = np.arange(0, 8, 0.02)
    run = Run("one", t, 14 + np.sin(t), 0.02 * np.sin(t), 0.3 * np.sin(t), 0.05 * np.sin(t), 500 * np.sin(t), 0.02)
    write_log(tmp_path / "log.csv", (dataclasses.replace(run, **{lacks: np.full(len(t), np.nan)}),))
    folder = tmp_path / "mine"
    folder.mkdir()
    arguments = ["--to", "race_stack", "--log", str(tmp_path / "log.csv"), "--out", str(folder)]
    assert main(["export", str(tmp_path / "car.yaml"), *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err == (
        f"driftjax export: log, run 'one': has no {words}, which the loss of an export is measured with; "
        "give runs that have it (--log, --runs), or leave out --log.\n"
    )
    assert list(folder.iterdir()) == []


def test_bad_input_is_one_sentence(tmp_path, capsys):
    assert main(["export", "sedan", "--to", "carmaker", "--out", str(tmp_path / "a")]) == 2
    assert "there is no format 'carmaker' (--to); choose one of race_stack, tum" in capsys.readouterr().err
    assert main(["export", "sedan", "--to", "autoware", "--top-speed", "-1", "--out", str(tmp_path / "b")]) == 2
    assert "top_speed is -1.0; it must be positive" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match=r"give another folder \(--out\)"):
        export_car(SEDAN, "autoware", tmp_path / "file")
    assert main(["export", "sedan", "--to", "autoware", "--out", str(tmp_path / "c")]) == 0
    assert json.loads((tmp_path / "c" / "export.json").read_text())["lost"] == {}
    assert "lost: no effect of this car" in capsys.readouterr().out
