"""Write the small logs beside this file: made-up drives in the column layouts of the shipped column maps.

Run `python tests/data/logs/write.py` from the repository root. Nothing in them was measured: a constant throttle or
acceleration and sines of low frequency, so that a reader's resampling leaves them as they are.
"""

from pathlib import Path

import numpy as np

HERE = Path(__file__).parent


def motion(duration: float, rate: float, speed: float) -> dict[str, np.ndarray]:
    """Time [s], vx, vy [m/s], yaw rate [rad/s], heading [rad] and steering angle [rad] of a slow slalom."""
    t = np.arange(round(duration * rate)) / rate
    wave = np.sin(2 * np.pi * 0.25 * t)
    r = 0.4 * wave
    psi = np.concatenate([[0.0], np.cumsum((r[1:] + r[:-1]) / 2) / rate])
    vx, vy = speed * (1 + 0.02 * t), -0.02 * speed * wave
    return {"t": t, "vx": vx, "vy": vy, "r": r, "psi": psi, "delta": 0.1 * wave}


def dart(group: str, speed: float) -> dict[str, np.ndarray]:
    """100 Hz motion capture of a 1:10 car; the motor is off in the first five samples, the last five are not valid."""
    m = motion(1.2, 100, speed)
    n, one = len(m["t"]), np.ones(len(m["t"]))
    x, y = np.cumsum(m["vx"]) / 100, np.cumsum(m["vy"]) / 100
    safety, ok = (np.arange(n) >= 5).astype(int), (np.arange(n) < n - 5).astype(int)
    columns = {"group": np.full(n, group), "run": np.full(n, "made_up_01"), "t_s": m["t"], "x_m": x, "y_m": y}
    columns |= {"psi_rad": m["psi"], "vx_mps": m["vx"], "vy_mps": m["vy"], "yaw_rate_radps": m["r"]}
    columns |= {"ax_mps2": 0.02 * speed * one, "ay_mps2": m["vx"] * m["r"], "throttle_cmd": 0.3 * one}
    return columns | {"delta_map_rad": m["delta"], "safety": safety, "imu_yaw_rate_radps": m["r"], "ok": ok}


def ferrari() -> dict[str, np.ndarray]:
    """100 Hz on board; a glitch of the steering sensor lasts from 0.8 to 0.9 s."""
    m = motion(2.0, 100, 30.0)
    glitch = ((m["t"] >= 0.8) & (m["t"] < 0.9)).astype(int)
    columns = {"t_s": m["t"], "psi_int_rad": m["psi"], "vx_mps": m["vx"], "vy_mps": m["vy"]}
    columns |= {"yaw_rate_radps": m["r"], "ax_mps2": 0.6 + 0 * m["t"], "ay_mps2": m["vx"] * m["r"]}
    return columns | {"delta_rad": m["delta"], "delta_glitch": glitch}


def genesis() -> dict[str, np.ndarray]:
    """100 Hz satellite navigation of a sedan."""
    m = motion(2.0, 100, 8.0)
    x, y = np.cumsum(m["vx"]) / 100, np.cumsum(m["vy"]) / 100
    columns = {"run": np.full(len(x), "made_up"), "t_s": m["t"], "x_m": x, "y_m": y, "psi_rad": m["psi"]}
    columns |= {"vx_mps": m["vx"], "vy_mps": m["vy"], "yaw_rate_radps": m["r"], "delta_rad": m["delta"]}
    return columns | {"a_long_mps2": 0.16 + 0 * x, "a_lat_mps2": m["vx"] * m["r"]}


def write(name: str, columns: dict[str, np.ndarray]) -> None:
    """One CSV file, numbers to five decimals."""
    cell = lambda value: f"{value:.5f}".rstrip("0").rstrip(".") if isinstance(value, np.floating) else str(value)
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(map(cell, row)) for row in rows)]
    (HERE / name).write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write("dart.csv", dart("rubber_free", 2.0))
    write("dart_steer_id.csv", dart("steer_id", 0.5))
    write("ferrari.csv", ferrari())
    write("genesis.csv", genesis())
