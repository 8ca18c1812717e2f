"""Variables that drive the contribution of each effect: what a diagnosis should name if the catalogue lacks it.

Names as in the log, and ax, ay (accelerations), alpha_f, alpha_r (slip angles), t (time), heat (sliding work), 1 (a
constant), delta_rate, Fxr_rate (of the commands). From the equations of each effect (driftjax/vehicle/effect).
"""

_GRIP = "alpha_f alpha_r beta r delta ay"
_REAR, _FRONT = "alpha_r beta ay", "alpha_f delta ay r"
_TABLE = {
    "friction": _GRIP,
    "friction_front": _FRONT,
    "friction_rear": _REAR,
    "stiffness_front": _FRONT,
    "stiffness_rear": _REAR + " r",
    "tyre_shape": _GRIP,
    "sliding_friction": _GRIP + " V",
    "load_sensitivity": _GRIP + " Fxr ax",
    "load_transfer_long": "Fxr ax",
    "load_transfer_lat": "ay r V beta",
    "combined_slip": "Fxr ax alpha_r beta",
    "relaxation_length": "delta delta_rate r V alpha_f alpha_r",
    "aero_drag": "V",
    "rolling_resistance": "V 1",
    "downforce": "V",
    "engine_drag": "Fxr V",
    "drive_gain": "Fxr ax",
    "drive_lag": "Fxr Fxr_rate ax",
    "power_limit": "Fxr V ax",
    "wheel_spin": "Fxr Fxr_rate ax",
    "differential_moment": "Fxr ax r",
    "torque_vectoring": "r delta V",
    "mass": "Fxr ax ay",
    "yaw_inertia": "delta delta_rate r alpha_f alpha_r",
    "cog_shift": _GRIP,
    "roll_lag": "ay r delta delta_rate",
    "roll_steer": "ay r",
    "steer_offset": "1 alpha_f V",
    "steer_gain": "delta",
    "steer_compliance": _FRONT,
    "steer_lag": "delta delta_rate",
    "steer_delay": "delta delta_rate",
    "steer_backlash": "delta delta_rate",
    "road_bank": "1 V psi",
    "road_grade": "psi 1",
    "side_wind": "psi V",
    "friction_patch": "s",
    "friction_fade": "heat t",
    "gyro_bias": "1 V",
    "gyro_scale": "r",
    "sideslip_bias": "1 beta",
    "speed_scale": "V",
    "channel_delay": "r delta delta_rate beta V ay",
    "imu_lever_arm": "r beta delta",
    "drive_split": "Fxr ax delta",
    "brake_split": "Fxr ax delta",
    "yaw_moment": "1",
    "traction_limit": "Fxr ax alpha_r beta",
}
DRIVERS: dict[str, frozenset[str]] = {name: frozenset(words.split()) for name, words in _TABLE.items()}
