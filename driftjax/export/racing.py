"""Exports for planners and stacks of small race cars: race_stack / On-Track-SysID, the TUM planner, f1tenth_gym."""

import io
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from driftjax.export.steady import cornering, grip_limits, truncate_at_peak
from driftjax.export.target import AXLES, Format, ReducedCar, save_text, save_yaml
from driftjax.vehicle.effect import reference
from driftjax.vehicle.effect.power_limit import limited_force

STEERS, SPEEDS = 160, 100  # rows and columns of the steering table; its reader takes the nearest of each
TABLE_SPEEDS = (0.3, 4.5)  # its slowest and fastest speed [sqrt(g L)]
FLOOR = "driftjax"  # the stack sorts tyres by floor
GGV_SPEEDS = 25  # rows of the tables of the TUM planner


def write_race_stack(reduced: ReducedCar, folder: Path) -> tuple[str, ...]:
    """Write NAME_pacejka.yaml, NAME_pacejka_default.yaml and NAME_pacejka_lookup_table.csv.

    F_y = D F_z sin(C arctan(B alpha - E (B alpha - arctan(B alpha)))), alpha = delta - arctan(...), left positive. The
    second file has the same tyres under the names of the stack's `PacejkaTireConfig`, which refuses others. The table
    has speeds in its first row [m/s], steering angles in its first column [rad], and the lateral acceleration of
    steady cornering [m/s^2]; NaN beyond the limit of grip. Angles lie close where they are small: the reader steers 0
    up to half the acceleration of the first row, and at high speed a car corners with small angles only.
    """
    car, v = reduced.car, reduced.vehicle
    axles = {"f": [car.Bf, car.Cf, car.muf, 0.0], "r": [car.Br, car.Cr, car.mur, 0.0]}
    model = {f"C_P{axle}": curve for axle, curve in axles.items()} | {
        "I_z": car.Iz, "a_max": reduced.forces[1] / car.m, "a_min": reduced.forces[0] / car.m,
        "h_cg": reduced.value("load_transfer_long.h"), "l_f": car.a, "l_r": car.b, "l_wb": car.wheelbase, "m": car.m,
        "model_name": reduced.name, "mu": 1.0, "tau_steer": reduced.value("steer_lag.tau"), "tire_model": "pacejka",
    }  # fmt: skip
    tyres = {f"{name}{axle}": one for axle, curve in axles.items() for name, one in zip("BCDE", curve, strict=True)}
    delta = v.delta_max * np.linspace(0.0, 1.0, STEERS) ** 2
    V = np.linspace(*TABLE_SPEEDS, SPEEDS) * reference(v, "speed")
    left, right = (cornering(reduced.full, sign * delta, V) for sign in (1, -1))
    table = np.zeros((STEERS + 1, SPEEDS + 1))
    table[0, 1:], table[1:, 0] = V, delta
    table[1:, 1:] = truncate_at_peak((left - right) / 2)  # an offset of the steering is not the table's
    text = io.StringIO()
    np.savetxt(text, table, delimiter=",")
    return (
        save_yaml(folder / f"{reduced.name}_pacejka.yaml", model),
        save_yaml(folder / f"{reduced.name}_pacejka_default.yaml", {"friction_coeff": 1.0, **tyres, "floor": FLOOR}),
        save_text(folder / f"{reduced.name}_pacejka_lookup_table.csv", text.getvalue()),
    )


def write_tum(reduced: ReducedCar, folder: Path) -> tuple[str, ...]:
    """Write ggv.csv (v, ax_max, ay_max) and ax_max_machines.csv (v, ax_max_machines) [m/s, m/s^2]."""
    V = np.linspace(0.0, reduced.top_speed, GGV_SPEEDS)
    moving = np.maximum(V, TABLE_SPEEDS[0] * reference(reduced.vehicle, "speed"))
    brake, drive, side = grip_limits(reduced.vehicle, moving)
    force = np.asarray(limited_force(jnp.asarray(reduced.forces[1]), jnp.asarray(V), reduced.value("power_limit.p")))
    machine = np.minimum(force / reduced.car.m, drive)
    return (
        save_text(folder / "ggv.csv", _csv("v_mps,ax_max_mps2,ay_max_mps2", V, brake, side)),
        save_text(folder / "ax_max_machines.csv", _csv("v_mps,ax_max_machines_mps2", V, machine)),
    )


def _csv(header: str, *columns: np.ndarray) -> str:
    text = io.StringIO()
    np.savetxt(text, np.stack(columns, axis=1), fmt="%.6f", delimiter=",", header=header)
    return text.getvalue()


def write_gym(reduced: ReducedCar, folder: Path) -> tuple[str, ...]:
    """Write f1tenth_gym.yaml, the dictionary `params` of the single-track model (`model: st`).

    F_y = mu C_S F_z alpha: C_S = B C of each axle, times its friction over `mu`, the mean.
    """
    car, v = reduced.car, reduced.vehicle
    mu, force = (car.muf + car.mur) / 2, reduced.forces[1]
    power = reduced.value("power_limit.p")
    params = {
        "mu": mu, "C_Sf": car.Bf * car.Cf * car.muf / mu, "C_Sr": car.Br * car.Cr * car.mur / mu,
        "lf": car.a, "lr": car.b, "h": reduced.value("load_transfer_long.h"), "m": car.m, "I": car.Iz,
        "s_min": -v.delta_max, "s_max": v.delta_max, "sv_min": -v.delta_rate_max, "sv_max": v.delta_rate_max,
        "v_switch": min(1 / (power * force), reduced.top_speed) if power else reduced.top_speed,
        "a_max": max(force, -reduced.forces[0]) / car.m, "v_min": -0.25 * reduced.top_speed, "v_max": reduced.top_speed,
        "width": v.width, "length": v.length,
    }  # fmt: skip
    return (save_yaml(folder / "f1tenth_gym.yaml", params),)


ENVELOPE = ("load_sensitivity", "load_transfer_long", "load_transfer_lat", "downforce", "sliding_friction",
            "tyre_curve_front", "tyre_curve_rear", "drive_split", "brake_split", "drive_gain",
            "power_limit")  # fmt: skip

RACE_STACK = Format(
    "race_stack and On-Track-SysID: tyres (YAML) and steering table (CSV)",
    frozenset({*AXLES, "load_transfer_long", "steer_lag"}),
    (
        "the stack's model takes longitudinal acceleration as given and knows no combined slip",
        "its model of the motor (C_0d, C_d, C_acc, C_dec, C_R) is not in the file",
        "the steering table is that of the car with all its steady effects, except an offset of the steering",
    ),
    write_race_stack,
)
TUM = Format(
    "TUM global_racetrajectory_optimization and laptime simulation: ggv.csv and ax_max_machines.csv",
    frozenset({*AXLES, *ENVELOPE}),
    (
        "a planner of limits holds no motion: what acts between the limits is lost",
        "ax_max is the braking at which the first axle slides; driving is limited by the grip of the driven axle, too",
        "aero_drag goes into the planner's own 'dragcoeff', which is the value c of this car",
    ),
    write_tum,
    predicts=False,
)
GYM = Format(
    "f1tenth_gym: params of the single-track model",
    frozenset({*AXLES, "load_transfer_long", "power_limit"}),
    (
        "its tyres are linear: there is no limit of grip, so friction only scales their stiffness",
        "it takes longitudinal acceleration as given; a_max is the larger of drive and brake",
    ),
    write_gym,
)
