"""Families of effects: parts of the car or of the measurement that a mechanic or an instrument would look at."""

DRIVE = "drive and brake"
FAMILIES = {
    "front tyre": ("friction_front", "stiffness_front", "tyre_curve_front"),
    "rear tyre": ("friction_rear", "stiffness_rear", "sliding_friction", "tyre_curve_rear"),
    "tyres": ("friction", "tyre_shape", "combined_slip", "relaxation_length", "friction_fade", "traction_limit"),
    "load transfer": ("load_sensitivity", "load_transfer_long", "load_transfer_lat", "downforce", "roll_lag",
                      "roll_steer"),
    DRIVE: ("drive_gain", "drive_lag", "power_limit", "wheel_spin", "differential_moment",
                        "torque_vectoring", "drive_split", "brake_split", "engine_drag", "rolling_resistance",
                        "aero_drag"),
    "steering": ("steer_offset", "steer_gain", "steer_compliance", "steer_lag", "steer_delay", "steer_backlash"),
    "chassis": ("mass", "yaw_inertia", "cog_shift", "yaw_moment", "track_width"),
    "road and weather": ("road_bank", "road_grade", "side_wind", "friction_patch"),
    "sensor": ("gyro_bias", "gyro_scale", "sideslip_bias", "speed_scale", "imu_lever_arm"),
    "time base": ("channel_delay",),
}  # fmt: skip
MEASUREMENT = ("sensor", "time base")  # families that leave the car's motion as it is
FAMILY_OF = {name: family for family, names in FAMILIES.items() for name in names}
