"""Map the steady states of a car: sideslip, steering and drive force over speed and yaw rate.

`driftjax equilibria` writes `equilibria.png` and `equilibria.csv` (one row per steady state).
"""

import csv
import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from jax import Array
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from driftjax.core import RESULTS, Control, State, require
from driftjax.environment import require_float64
from driftjax.equilibrium import Branch, Equilibrium, SpeedYaw, decoupled_roots, preference, solve_equilibrium
from driftjax.vehicle import AnyCar, Extended, SingleTrack, VehicleConfig, build_car, load_vehicle
from driftjax.vehicle.single_track import G

NEAR = (1.0, 0.8, 0.9, 1.1, 1.2)  # yaw rates whose nominal states are guesses for an extended car, over its own [-]
SAME = 1e-4  # difference of sideslip [rad], steering [rad] and force over weight within which two states are one
SHOWN = (Branch.GRIP, Branch.COUNTERSTEER, Branch.FRONT_SATURATED)
TITLES = {
    Branch.GRIP: "grip",
    Branch.COUNTERSTEER: "drift, countersteer",
    Branch.FRONT_SATURATED: "drift, front saturated",
}


@dataclasses.dataclass(frozen=True)
class MapConfig:
    """Map of a car's steady states in left turns; the nominal car's in right turns mirror them."""

    vehicle: str = "sedan"
    """Car: a shipped name (sedan, rc) or the path of a vehicle YAML, of an extended car too."""
    V_min: float = 0.0
    """Lowest speed [m/s]; 0 takes that of 3 wheelbases radius at the friction limit."""
    V_max: float = 0.0
    """Highest speed [m/s]; 0 takes three times the lowest."""
    num_V: int = 41
    """Speeds [-]."""
    ratio_min: float = 0.5
    """Lowest V r / (mu g) [-]."""
    ratio_max: float = 1.4
    """Highest V r / (mu g) [-]."""
    num_ratio: int = 73
    """Values of V r / (mu g) [-]."""

    def __post_init__(self) -> None:
        require(self.num_V > 1 and self.num_ratio > 1, "keys 'num_V' and 'num_ratio' must be at least 2.")
        require(0 < self.ratio_min < self.ratio_max, "key 'ratio_max' must exceed 'ratio_min', both positive.")
        require(self.V_min >= 0 and self.V_max >= 0, "keys 'V_min' and 'V_max' are speeds; give 0 or more m/s.")
        require(not 0 < self.V_max <= self.V_min, "key 'V_max' must exceed 'V_min'.")


def equilibria(vehicle: VehicleConfig, V: ArrayLike, r: ArrayLike) -> xr.Dataset:
    """Solve for every steady state of a car at speeds `V` (n,) [m/s] and yaw rates `r` (n,) [rad/s].

    Damped Gauss-Newton from every root of the decoupled problem, each confirmed on the full car, named effects
    included. Dimensions (point, root), SI; entries without a state are NaN and have branch -1 (see `Branch`). Raises
    `BadInput` for shapes that differ.
    """
    require_float64()
    V, r = np.atleast_1d(np.asarray(V, float)), np.atleast_1d(np.asarray(r, float))
    require(V.ndim == 1 and V.shape == r.shape, f"V has shape {V.shape} and r {r.shape}; give one row of each.")
    points = solve_map(build_car(vehicle), jnp.asarray(V), jnp.asarray(r))
    good = np.asarray(points.result == RESULTS.successful)
    columns = {
        "beta": (points.x.beta, "rad", "sideslip, left positive"),
        "delta": (points.u.delta, "rad", "steering angle, left positive"),
        "Fxr": (points.u.Fxr, "N", "longitudinal force of the rear axle"),
        "residual": (points.residual, "1", "largest scaled rate left"),
    }
    data = {
        name: (("point", "root"), np.where(good, np.asarray(values), np.nan), {"units": units, "long_name": words})
        for name, (values, units, words) in columns.items()
    }
    flags = {"flag_values": [int(b) for b in Branch], "flag_meanings": " ".join(b.name.lower() for b in Branch)}
    data["branch"] = (("point", "root"), np.where(good, np.asarray(points.kind), -1), flags)
    coords = {"V": ("point", V, {"units": "m/s"}), "r": ("point", r, {"units": "rad/s"})}
    return xr.Dataset(data, coords, {"vehicle": vehicle.name})


@eqx.filter_jit
def solve_map(car: AnyCar, V: Array, r: Array) -> Equilibrium:
    """Solve for every steady state at each (V, r) on the full model; rows (point, root), kind -1 is padding."""
    if isinstance(car, Extended):
        return jax.vmap(lambda V, r: around_nominal(car, V, r))(V, r)

    def at(V: Array, r: Array) -> Equilibrium:
        roots = decoupled_roots(car, V, r)

        def confirm(x: State, u: Control, kind: Array, exists: Array) -> Equilibrium:
            out = solve_equilibrium(car, car, SpeedYaw(V, r), (x, u), branch=kind)
            result = RESULTS.where(exists, out.result, RESULTS.no_root)  # pyright: ignore[reportArgumentType]
            return eqx.tree_at(lambda e: (e.kind, e.result), out, (jnp.where(exists, out.kind, -1), result))

        return jax.vmap(confirm)(roots.x, roots.u, roots.kind, roots.valid)

    return jax.vmap(at)(V, r)


def around_nominal(car: Extended, V: Array, r: Array) -> Equilibrium:
    """Return the steady states of an extended car at one (V, r), from those of its nominal car at `NEAR` yaw rates.

    The nominal car may have none at this yaw rate: two drifts merge at a fold and vanish, and effects move the fold.
    """
    roots = jax.vmap(lambda share: decoupled_roots(car.nominal, V, share * r))(jnp.asarray(NEAR))
    x, u, exists = jax.tree.map(jnp.ravel, (roots.x, roots.u, roots.valid))
    out = jax.vmap(lambda x, u: solve_equilibrium(car, car, SpeedYaw(V, r), (x, u)))(x, u)
    good = exists & (out.result == RESULTS.successful)
    at = jnp.stack([out.x.beta, out.u.delta, out.u.Fxr / (car.m * G)])
    apart = jnp.max(jnp.abs(at[:, :, None] - at[:, None, :]), axis=0)
    known = jnp.any(jnp.tril((apart < SAME) & good[None, :], -1), axis=1)  # found from an earlier guess
    kind = jnp.where(good & ~known, out.kind, -1)
    unless = lambda kind, result: RESULTS.where(kind >= 0, result, RESULTS.no_root)  # pyright: ignore
    return eqx.tree_at(lambda e: (e.kind, e.result), out, (kind, jax.vmap(unless)(kind, out.result)))


def grid(cfg: MapConfig, car: AnyCar) -> tuple[np.ndarray, np.ndarray]:
    """Return speeds [m/s] and V r / (mu g) [-] of the map."""
    limit, wheelbase = float(car.tyre.mu) * G, float(car.a + car.b)
    low = cfg.V_min or (3 * wheelbase * limit) ** 0.5
    return np.linspace(low, cfg.V_max or 3 * low, cfg.num_V), np.linspace(cfg.ratio_min, cfg.ratio_max, cfg.num_ratio)


def write_map(cfg: MapConfig, out: Path) -> dict[str, float]:
    """Write map and table to `out`; return counts and the worst residual."""
    vehicle = load_vehicle(cfg.vehicle)
    car = build_car(vehicle)
    speeds, ratios = grid(cfg, car)
    limit = float(car.tyre.mu) * G
    V, ratio = (axis.ravel() for axis in np.meshgrid(speeds, ratios))
    points = solve_map(car, jnp.asarray(V), jnp.asarray(ratio * limit / V))
    out.mkdir(parents=True, exist_ok=True)
    solved = np.asarray(points.result == RESULTS.successful)
    write_table(out / "equilibria.csv", points, solved)
    words = "the nominal car" if isinstance(car, SingleTrack) else f"the car with {', '.join(car.names)}"
    figure = draw(points, solved, speeds, ratios, f"{vehicle.name}: steady states of {words}")
    figure.savefig(out / "equilibria.png", dpi=130)
    plt.close(figure)
    kind = np.asarray(points.kind)
    share = {b: float(np.mean(np.any(solved & (kind == b), axis=1))) for b in SHOWN}
    drift_ratio = ratio[np.any(solved & (kind == Branch.COUNTERSTEER), axis=1)]
    return {
        "steady_states": float(solved.sum()),
        "unconfirmed": float(np.sum((kind >= 0) & ~solved)),
        "share_with_grip": share[Branch.GRIP],
        "share_with_countersteer_drift": share[Branch.COUNTERSTEER],
        "share_with_front_saturated_drift": share[Branch.FRONT_SATURATED],
        "lowest_drift_ratio": float(drift_ratio.min()) if drift_ratio.size else float("nan"),
        "worst_residual": float(np.max(np.asarray(points.residual)[solved], initial=0.0)),
    }


def write_table(path: Path, points: Equilibrium, solved: np.ndarray) -> None:
    """Write one row per steady state, SI and radians."""
    columns = (points.x.V, points.x.r, points.x.beta, points.u.delta, points.u.Fxr, points.residual)
    values = [np.asarray(column)[solved] for column in columns]
    names = [Branch(k).name.lower() for k in np.asarray(points.kind)[solved]]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["V", "r", "beta", "delta", "Fxr", "residual", "branch"])
        for *numbers, name in zip(*values, names, strict=True):
            writer.writerow([f"{number:.9g}" for number in numbers] + [name])


def draw(points: Equilibrium, solved: np.ndarray, speeds: np.ndarray, ratios: np.ndarray, title: str) -> Figure:
    """Draw one row per branch, one column per unknown; hatched where no such steady state exists.

    Of two on one branch the one with more sideslip is shown, then the one with more steering into the turn.
    """
    kind = np.asarray(points.kind)
    force = 1e3 if np.nanmax(np.abs(np.asarray(points.u.Fxr)[solved]), initial=0.0) > 1e3 else 1.0
    columns = (
        ("sideslip beta [deg]", np.rad2deg(points.x.beta), "viridis"),
        ("steering delta [deg]", np.rad2deg(points.u.delta), "coolwarm"),
        (f"drive force Fxr [{'kN' if force > 1 else 'N'}]", np.asarray(points.u.Fxr) / force, "magma"),
    )
    figure, axes = plt.subplots(3, 3, figsize=(13, 10), sharex=True, sharey=True, layout="constrained")
    for row, branch in zip(axes, SHOWN, strict=True):
        match = solved & (kind == branch)
        exists = match.any(axis=1)
        best = np.argmax(np.where(match, preference(points.x, points.u), -np.inf), axis=1)
        for axis, (label, values, colours) in zip(row, columns, strict=True):
            level = np.where(exists, np.take_along_axis(values, best[:, None], axis=1)[:, 0], np.nan)
            axis.set_facecolor("0.93")
            axis.patch.set(hatch="///", edgecolor="0.75")
            level = np.ma.masked_invalid(level.reshape(len(ratios), len(speeds)))
            mesh = axis.pcolormesh(speeds, ratios, level, cmap=colours, shading="nearest")
            figure.colorbar(mesh, ax=axis, label=label)
            axis.set_title(TITLES[branch])
        row[0].set_ylabel("V r / (mu g) [-]")
    for axis in axes[-1]:
        axis.set_xlabel("speed V [m/s]")
    figure.suptitle(f"{title} (left turn; hatched: none on this branch)")
    return figure
