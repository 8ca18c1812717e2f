"""Exports for simulators of full-size cars: CommonRoad, Autoware, Open-Car-Dynamics."""

import json
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from driftjax.export.target import AXLES, Format, ReducedCar, save_text, save_yaml

ID = 5  # vehicle number of the files; CommonRoad's own are 1 to 4
SPIN = 0.016  # spin inertia of the wheels of one axle over m R_w^2, as of a sedan (3 kg m^2) [-]
SLIP_RATIO = 1.2  # longitudinal over lateral slip stiffness, as of the shipped plant [-]
AIR = 1.225  # density of air [kg/m^3]
FASTEST_LAG = 0.002  # least time constant of an actuator that divides by it [s]
OCD_STEP = 0.0008  # Open-Car-Dynamics' own integration step [s]
OCD = "vehicle_dynamics_single_track"
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")


def side_force_under_drive(ellipse: float, C: float, B: float) -> tuple[float, float, float]:
    """Fit B, C, E of CommonRoad's weight cos(C arctan(B kappa - E (...))) to the friction ellipse of this car.

    The drive force at the slip kappa is mu F_z sin(C arctan(B kappa)); the ellipse leaves sqrt(1 - ellipse F^2).
    """
    if not ellipse:
        return 0.0, 0.0, 0.0
    kappa = np.linspace(0.0, 1.2 * np.tan(np.pi / (2 * C)) / B, 60)
    left = np.sqrt(np.maximum(1 - ellipse * np.sin(C * np.arctan(B * kappa)) ** 2, 0.04))

    def off(q: np.ndarray) -> np.ndarray:
        x = q[0] * kappa
        return np.cos(q[1] * np.arctan(x - q[2] * (x - np.arctan(x)))) - left

    fit = least_squares(off, [B, 1.0, 0.0], bounds=([0, 0, -10], [20 * B, 2, 1])).x
    return float(fit[0]), float(fit[1]), float(fit[2])


def write_commonroad(reduced: ReducedCar, folder: Path) -> tuple[str, ...]:
    """Write parameters_vehicle5.yaml and parameters_tire.yaml for `setup_vehicle_parameters(5, Path(folder))`.

    Both axles have one tyre: the nominal one with the effects that both share. There are no multi-body parameters.
    """
    car, v, h = reduced.car, reduced.vehicle, reduced.value("load_transfer_long.h")
    mu, B, C = car.muf, car.Bf, car.Cf
    power, force, R = reduced.value("power_limit.p"), reduced.forces[1], reduced.wheel_radius
    vehicle = {
        "l": v.length, "w": v.width,
        "steering": {"min": -v.delta_max, "max": v.delta_max, "v_min": -v.delta_rate_max, "v_max": v.delta_rate_max},
        "longitudinal": {
            "a_max": max(force, -reduced.forces[0]) / car.m,
            "v_max": reduced.top_speed, "v_min": -0.25 * reduced.top_speed,
            "v_switch": min(1 / (power * force), reduced.top_speed) if power else reduced.top_speed,
        },
        "m": car.m, "a": car.a, "b": car.b, "I_z": car.Iz, "h_cg": h, "h_s": h, "R_w": R, "I_y_w": SPIN * car.m * R**2,
        "T_sb": reduced.value("brake_split.p"), "T_se": reduced.value("drive_split.p"),
    }  # fmt: skip
    zero = {f"p_{name}": 0.0 for name in ("dx3", "ex1", "hx1", "vx1", "dy3", "ey1", "hy1", "hy3", "vy1", "vy3")}
    zero |= {f"r_{name}": 0.0 for name in ("bx1", "bx2", "cx1", "ex1", "hx1", "by2", "by3", "hy1", "vy1", "vy3", "vy4",
                                           "vy5", "vy6")}  # fmt: skip
    by, cy, ey = side_force_under_drive(car.ellipse, C, SLIP_RATIO * B)
    tire = zero | {
        "p_cx1": C, "p_dx1": mu, "p_kx1": SLIP_RATIO * B * C * mu, "p_cy1": C, "p_dy1": mu, "p_ky1": -B * C * mu,
        "r_by1": by, "r_cy1": cy, "r_ey1": ey,
    }  # fmt: skip
    return (
        save_yaml(folder / f"parameters_vehicle{ID}.yaml", vehicle),
        save_yaml(folder / "parameters_tire.yaml", {"tire": tire}),
    )


def write_autoware(reduced: ReducedCar, folder: Path) -> tuple[str, ...]:
    """Write simulator_model.param.yaml of Autoware's simple_planning_simulator (DELAY_STEER_ACC_GEARED).

    steer_bias is what its steering sensor reads too much: the wheels turn to the command times its gain, less the bias.
    vel_rate_lim bounds commands before their gain, and accelerations after it.
    """
    v, value = reduced.vehicle, reduced.value
    gain = 1 + value("steer_gain.p")
    limit = max(v.Fxr_max, -v.Fxr_min) / reduced.car.m * max(1.0, 1 + value("drive_gain.p"))
    parameters = {
        "simulated_frame_id": "base_link", "origin_frame_id": "map", "vehicle_model_type": "DELAY_STEER_ACC_GEARED",
        "initialize_source": "INITIAL_POSE_TOPIC", "timer_sampling_time_ms": 25, "add_measurement_noise": False,
        "vel_lim": reduced.top_speed, "vel_rate_lim": limit,
        "steer_lim": v.delta_max, "steer_rate_lim": v.delta_rate_max,
        "acc_time_delay": 0.0, "acc_time_constant": value("drive_lag.tau"),
        "steer_time_delay": value("steer_delay.d"), "steer_time_constant": value("steer_lag.tau"),
        "steer_dead_band": value("steer_backlash.w"), "steer_bias": 0.0 - value("steer_offset.p") * gain,
        "debug_acc_scaling_factor": 1 + value("drive_gain.p"), "debug_steer_scaling_factor": gain,
        "x_stddev": 0.0001, "y_stddev": 0.0001,
    }  # fmt: skip
    return (save_yaml(folder / "simulator_model.param.yaml", {"/**": {"ros__parameters": parameters}}),)


def write_open_car_dynamics(reduced: ReducedCar, folder: Path) -> tuple[str, ...]:
    """Write the JSON of the Open-Car-Dynamics model FX, PT1, SINGLE_TRACK, MF_SIMPLE, DEFAULT.

    F_y = D F_z sin(C arctan(B tan(alpha))): B is the stiffness factor at small slip. The area is 1 m^2, so that
    c_d and c_l are the coefficients of drag and lift times area.
    """
    car, v, R = reduced.car, reduced.vehicle, reduced.wheel_radius
    spin = SPIN * car.m * R**2
    content: dict = {
        "drivetrain.I_wheel_front_kgm2": spin / 2, "drivetrain.I_wheel_rear_kgm2": spin / 2,
        "drivetrain.LSD_lock_coast": 0.0, "drivetrain.LSD_lock_drive": 0.0, "drivetrain.LSD_preload": 0.0,
        "drivetrain.brake_bias_front": reduced.value("brake_split.p"), "drivetrain.intertia_kgm2": 0.0,
        "drivetrain.transmission_ratio": 1.0, "drivetrain.wheel_radius_m": R, "integration_step_size_s": OCD_STEP,
        "steering_actuator.T_PT1": max(reduced.value("steer_lag.tau"), FASTEST_LAG),
        "steering_actuator.angle_max_rad": v.delta_max,
        "steering_actuator.angle_rate_max_radps": v.delta_rate_max,
        "steering_actuator.static_offset_rad": reduced.value("steer_offset.p"),
    }  # fmt: skip
    for state in ("drivetrain.omega_FL_radps", "drivetrain.omega_FR_radps", "drivetrain.omega_diff_rear_radps",
                  "drivetrain.omega_rear_axle_radps", "steering_actuator.position_rad",
                  "vehicle_dynamics.psi_dot_radps", "vehicle_dynamics.psi_rad", "vehicle_dynamics.v_x_mps",
                  "vehicle_dynamics.v_y_mps", "vehicle_dynamics.x_m", "vehicle_dynamics.y_m"):  # fmt: skip
        content[f"initial_state.{state}"] = 0.0
    body = {
        "aerodynamics.A_m2": 1.0, "aerodynamics.air_density_kgpm3": AIR,
        "aerodynamics.c_d": 2 * reduced.value("aero_drag.c") / AIR,
        "aerodynamics.c_l": -2 * reduced.value("downforce.c") / AIR,
        "aerodynamics.c_l_velocity_scaling.delta_c_l": [0.0, 0.0],
        "aerodynamics.c_l_velocity_scaling.vel_mps": [0.0, 100.0], "aerodynamics.d_aero_center_cog_m": 0.0,
        "aerodynamics.pitch_aero_center_translation.aero_center_translation_m": [0.0, 0.0],
        "aerodynamics.pitch_aero_center_translation.pitch_rad": [-np.pi, np.pi],
        "cog.distance_from_front_axle_m": car.a, "mass_vehicle_kg": car.m, "moment_of_inertia_kgpm2.z": car.Iz,
        "tire.rolling_radius_m.front": R, "tire.rolling_radius_m.rear": R,
        "tire.rolling_radius_m.velocity_scaling.factors": [1.0, 1.0],
        "tire.rolling_radius_m.velocity_scaling.velocity_points_mps": [0.0, 100.0],
        "tire.rolling_resistance_coefficient": reduced.value("rolling_resistance.f"), "wheelbase_m": car.wheelbase,
    }  # fmt: skip
    for wheel in WHEELS:
        B, C, D = (car.Bf, car.Cf, car.muf) if wheel.startswith("front") else (car.Br, car.Cr, car.mur)
        for axis, factor in (("lateral", B), ("longitudinal", SLIP_RATIO * B)):
            names = {"B": factor, "C": C, "D": D, "E": 0.0}
            body |= {f"z.tire_model.{wheel}.{axis}.{name}": value for name, value in names.items()}
    content |= {f"{OCD}.{name}": value for name, value in body.items()}
    text = json.dumps(dict(sorted(content.items())), indent=4)
    return (save_text(folder / "OCD_Vehicle_FX__PT1__SINGLE_TRACK__MF_SIMPLE__DEFAULT.json", text + "\n"),)


COMMONROAD = Format(
    "CommonRoad vehicle models: parameter files of the single-track and the drift model (ST, STD)",
    frozenset({"friction", "tyre_shape", "mass", "yaw_inertia", "cog_shift", "load_transfer_long", "combined_slip",
               "drive_split", "brake_split", "power_limit"}),
    (
        "both axles have one tyre: what differs between front and rear is left out",
        "its wheels spin: rolling radius, spin inertia and longitudinal slip stiffness were chosen for the car's size",
        "parameters of the multi-body model are not in the files",
    ),
    write_commonroad,
)  # fmt: skip
AUTOWARE = Format(
    "Autoware simple_planning_simulator: simulator_model.param.yaml",
    frozenset({"steer_lag", "steer_delay", "steer_offset", "steer_gain", "steer_backlash", "drive_lag", "drive_gain"}),
    (
        "its model is a kinematic single track: it has no tyres at all",
        "steer_dead_band stands for the play of the steering, which it resembles",
        "steer_bias is what its steering sensor reads too much: an offset of the steering with the other sign",
        "its lags are never below 0.03 s, and one limit holds for drive and brake, the larger",
        "the wheelbase is in vehicle_info.param.yaml, not in this file",
    ),
    write_autoware,
)
OPEN_CAR_DYNAMICS = Format(
    "Open-Car-Dynamics: JSON of the model FX, PT1, SINGLE_TRACK, MF_SIMPLE, DEFAULT",
    frozenset({*AXLES, "steer_lag", "steer_offset", "aero_drag", "downforce", "rolling_resistance", "brake_split"}),
    (
        "its tyre takes tan(alpha) for alpha, and no side force is lost to drive or brake force",
        "its wheels spin: rolling radius, spin inertia and longitudinal slip stiffness were chosen for the car's size",
    ),
    write_open_car_dynamics,
)
