"""A small run folder with plausible numbers, made without driving: a left hairpin, three plants, all stages."""

from pathlib import Path

import numpy as np
import xarray as xr

from driftjax.store import RunFolder, dataset
from driftjax.store.variables import PLAN

CODES = {"RUNNING": 0, "COMPLETED": 1, "SPUN": 2, "OFF_TRACK": 3, "STALLED": 4, "TIMEOUT": 5, "NON_FINITE": 6}
DT, STEPS, ROWS = 0.05, 220, 80
ERRORS = {"pursuit": 2.6, "lqr": 1.9, "nominal": 1.4, "single-layer": 1.0, "gpr-1": 0.8, "gpr-2": 0.6,
          "explore-1": 0.5, "explore-2": 0.4}  # fmt: skip
BEST = {"gpr-best": 0.62, "explore-best": 0.42}  # stages driven with the best setting, on request


def bump(s, start, end, ramp):
    """1 between start and end, falling smoothly to 0 over `ramp` outside."""
    rise, fall = np.clip((s - start) / ramp + 1, 0, 1), np.clip((end - s) / ramp + 1, 0, 1)
    return (3 * rise**2 - 2 * rise**3) * (3 * fall**2 - 2 * fall**3)


def synthetic_plan(car: str = "sedan") -> xr.Dataset:
    """A left hairpin of 15 m between straights of 45 m, drifted."""
    s = np.linspace(0, 137, 301)
    kappa = bump(s, 50, 87, 8) / 15 * 0.995
    psi = np.concatenate([[0], np.cumsum((kappa[1:] + kappa[:-1]) / 2 * np.diff(s))])
    cumulated = lambda f: np.concatenate([[0], np.cumsum((f[1:] + f[:-1]) / 2 * np.diff(s))])
    x, y = cumulated(np.cos(psi)), cumulated(np.sin(psi))
    V = 12.5 - 1.5 * bump(s, 45, 80, 15)
    beta, r = -0.45 * bump(s, 48, 82, 8), V * kappa
    e = 1.2 * bump(s, 64, 68, 14) - 0.6 * bump(s, 30, 36, 14)
    px, py = x - e * np.sin(psi), y + e * np.cos(psi)
    S = np.concatenate([[0], np.cumsum(np.hypot(np.diff(px), np.diff(py)))])
    course = np.unwrap(np.arctan2(np.gradient(py, S), np.gradient(px, S)))
    t = np.concatenate([[0], np.cumsum(np.diff(S) / (V[1:] + V[:-1]) * 2)])
    drift = -beta > 0.15
    values = {
        "s": s, "t": t, "V": V, "beta": beta, "r": r, "e": e, "theta": -beta, "delta": 0.1 * np.sign(r) + beta * 0.8,
        "Fxr": 2000 + 4000 * drift, "x": px, "y": py, "psi": course - beta, "S": S, "drift": drift,
        "track_x": x, "track_y": y, "left_x": x - 3 * np.sin(psi), "left_y": y + 3 * np.cos(psi),
        "right_x": x + 3 * np.sin(psi), "right_y": y - 3 * np.cos(psi), "path_s": S, "path_x": px, "path_y": py,
        "path_psi": course, "path_kappa": np.gradient(course, S),
    }  # fmt: skip
    attrs = {"car": car, "drift_start": S[drift][0], "drift_end": S[drift][-1], "lap_time": t[-1]}
    return dataset(values, attrs, PLAN)


def synthetic_stage(name: str, plan: xr.Dataset, controllers: tuple[str, ...], plants: int, seed: int) -> xr.Dataset:
    """Laps whose lateral error swells in the corner to about ERRORS[name]; in `nominal` the last plant spins."""
    generator = np.random.default_rng(seed)
    lanes = [(controller, plant) for controller in controllers for plant in range(plants)]
    rows = [_lap(name, plan, c, p, spins=name == "nominal" and p == plants - 1, generator=generator) for c, p in lanes]
    values = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    values |= {"t": DT * np.arange(STEPS), "controller": [c for c, _ in lanes], "seed": np.zeros(len(lanes), int)}
    values["plant"] = [f"sedan_0_{plant}" for _, plant in lanes]
    if name.startswith(("gpr", "explore")):
        wide = 0.5 if name.startswith("explore") else 0.25
        centre = np.array([11.0, -0.45, 0.75, -0.3, 5500.0])
        spread = np.array([wide * 1.5, wide * 0.3, wide * 0.4, 0.1, 600.0])
        values["gp_Z"] = centre + spread * generator.normal(size=(len(lanes), ROWS, 5))
        values["gp_mask"] = np.arange(ROWS) < 60 + np.zeros((len(lanes), 1))
        values["gp_std"] = np.abs(generator.normal(size=(len(lanes), STEPS, 3)))
        values["output"] = ["dV", "dbeta", "dr"]
        values["feature"] = ["V", "beta", "r", "delta", "Fxr"]
    if name.startswith("explore"):
        values |= _speed_sets(plan, len(lanes), generator)
    return dataset(values, {"codes": CODES, "car": "sedan", "stage": name})


def _lap(name: str, plan: xr.Dataset, controller: str, plant: int, spins: bool, generator) -> dict:
    start, end, S = plan.attrs["drift_start"], plan.attrs["drift_end"], plan["S"].values
    V_node = plan["V"].values * (0.95 if controller == "pursuit" else 1.0)
    s = np.zeros(STEPS)
    for k in range(1, STEPS):
        s[k] = s[k - 1] + DT * np.interp(s[k - 1], S, V_node)
    stop = 0.5 * (start + end) if spins else S[-1]
    alive = s < stop
    size = (ERRORS | BEST)[name] * (1 + 0.15 * plant) * (1.6 if controller == "paper" else 1.0)
    corner = bump(s, start + 4, end - 4, 8)
    at = lambda field, to="S": np.interp(s, plan[to].values, plan[field].values)
    e = -size * corner * (1 + 0.3 * np.sin(s / 6 + plant)) + 0.05 * generator.normal(size=STEPS).cumsum() / 5
    V_ref, beta_ref, r_ref = at("V"), at("beta"), at("r")
    V = V_ref * (1 + 0.06 * (ERRORS | BEST)[name] * corner * np.sin(s / 9 + plant)) + 0.02 * generator.normal(
        size=STEPS
    )
    beta = (0.2 if name == "pursuit" else 1.0) * beta_ref * (1 + 0.1 * np.sin(s / 5)) - 1.2 * spins * corner * (s > 55)
    psi = at("path_psi", "path_s")
    rows = {
        "alive": alive, "s": s, "e": e, "V": V, "beta": beta, "r": r_ref * 1.02, "psi": psi - beta,
        "x": at("path_x", "path_s") - e * np.sin(psi), "y": at("path_y", "path_s") + e * np.cos(psi),
        "drifting": (s > start - 6) & (s < end + 4) & (name != "pursuit"), "solved": np.ones(STEPS, bool),
        "kkt": np.full(STEPS, 1e-6), "num_steps": np.full(STEPS, 8, np.int32), "V_ref": V_ref, "beta_ref": beta_ref,
        "r_ref": r_ref, "e_ref": 0.2 * corner,
        "delta_command": at("delta"), "Fxr_command": at("Fxr"), "delta": at("delta"), "Fxr": at("Fxr"),
    }  # fmt: skip
    inside = alive & (s > start) & (s < end)
    misread = 0.4 * (name == "gpr-2" and plant == 0)  # the sensors of this lap are off
    rows |= {
        "lateral_error_measured": np.abs(e[inside]).mean() + misread,
        "code": np.array(CODES["SPUN" if spins else "COMPLETED"]), "completed": np.array(not spins),
        "lateral_error": np.abs(e[inside]).mean(), "lateral_error_max": np.abs(e[inside]).max(),
        "velocity_rmse": np.sqrt(np.mean((V - V_ref)[inside] ** 2)),
        "drift_share": np.mean(np.abs(beta[inside]) > 0.15),
    }  # fmt: skip
    return rows


def _speed_sets(plan: xr.Dataset, lanes: int, generator) -> dict:
    s = np.linspace(plan.attrs["drift_start"], plan.attrs["drift_end"], 40)
    origin = np.interp(s, plan["S"].values, plan["V"].values) * np.ones((lanes, 1))
    target = 0.25 * np.sin((s - s[0]) / 7) * (1 + 0.2 * generator.normal(size=(lanes, 1))) + 0.1
    shares = np.array([0.4, 0.7, 1.0])
    gamma = shares[:, None] * np.clip(target, -0.4, 0.4)[:, None, :] * 0.8
    V = origin[:, None, :] + gamma
    return {
        "vset_s": s * np.ones((lanes, 1)), "vset_origin": origin, "vset_target": target, "vset_V": V,
        "vset_V_ep": V.mean(axis=2), "vset_lower": origin - 0.4, "vset_upper": origin + 0.4,
    }  # fmt: skip


def summary(values) -> dict:
    """Mean, a symmetric interval and the values per plant."""
    mean, half = float(np.mean(values)), float(np.std(values)) + 0.02
    return {"mean": mean, "ci95": [mean - half, mean + half],
            "per_plant": {f"sedan_0_{i}": float(value) for i, value in enumerate(values)}}  # fmt: skip


def synthetic_results(run: RunFolder) -> dict:
    """results.json of the stages in `run`."""
    names, stages = {number: name for name, number in CODES.items()}, []
    for stage in run.finished():
        data, rows = run.read_stage(stage), {}
        for controller in dict.fromkeys(data["controller"].values.tolist()):
            chosen = data.isel(lane=np.flatnonzero(data["controller"].values == controller))
            codes = [names[code] for code in chosen["code"].values.tolist()]
            rows[controller] = {
                key: summary(chosen[key].values) for key in ("lateral_error", "velocity_rmse", "drift_share")
            } | {
                "completed": [codes.count("COMPLETED"), len(codes)],
                "codes": {code: codes.count(code) for code in dict.fromkeys(codes)},
            }
        stages.append({"name": stage, "controllers": rows})
    reduction = lambda value, paper: {"value": value, "ci95": [value - 6, value + 6], "paper": paper}
    whole = {
        "nominal": 1.4, "gpr": 0.6, "explored": 0.4, "reduction_gpr": reduction(57.1, 52.8),
        "reduction_exploration": reduction(33.3, 27.1), "reduction_velocity_rmse": reduction(18.0, 10.6),
    }  # fmt: skip
    nothing = {"value": None, "ci95": [None, None], "paper": 27.1}
    return {"car": "sedan", "seed": 0, "stages": stages,
            "summary": {"path": whole, "paper": whole | {"reduction_exploration": nothing}}}  # fmt: skip


def synthetic_run(path: Path, plants: int = 3, stages: tuple[str, ...] = tuple(ERRORS)) -> RunFolder:
    """A finished run below `path`."""
    config = {"car": "sedan", "vehicle": "sedan", "track": "sedan_corner", "plants": plants}
    run, plan = RunFolder.create(path, config), synthetic_plan()
    run.write_dataset("plan.nc", plan)
    for number, name in enumerate(stages):
        controllers = (name,) if name == "pursuit" else ("path", "paper")
        run.write_stage(name, synthetic_stage(name, plan, controllers, plants, number), b"state")
    run.write_json("results", synthetic_results(run))
    return run
