"""Export the drift MPC as compiled programs that run without this package."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
from jax import Array, export

from driftjax.control.drift_mpc import DriftMPC, MPCState
from driftjax.control.mpc import Reference
from driftjax.control.mpc_solution import MPCPlan
from driftjax.core import Control, write_text

PLATFORMS = ("cpu", "cuda")


def export_mpc(mpc: DriftMPC, folder: str | Path) -> Path:
    """Write both halves of the real-time iteration of `mpc`, for one car, to a folder; returns it.

    `prepare.jax` and `respond.jax` are read by `jax.export.deserialize` of any later JAX, on a CPU or a CUDA device,
    and need no other package; `mpc.json` says what goes in and comes out. Car, residual, weights and limits are fixed.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    shapes = _shapes(mpc.horizon)
    like = [jax.ShapeDtypeStruct(shape, float) for shape, _ in shapes.values()]
    structure = None

    def prepare(x: Array, command: Array, lagged_input: Array, reference: Array, X: Array, U: Array) -> list[Array]:
        nonlocal structure
        last = MPCPlan(Control(U[0, 0], U[0, 1]), X, U)
        prepared = mpc.prepare(MPCState(x, command, lagged_input), Reference(*reference), last)
        leaves, structure = jax.tree.flatten(prepared)
        return leaves

    def respond(prepared: list[Array], x: Array, command: Array, lagged_input: Array) -> tuple[Array, ...]:
        answer = mpc.respond(jax.tree.unflatten(structure, prepared), MPCState(x, command, lagged_input))
        command = jnp.stack([answer.u.delta, answer.u.Fxr])
        return command, answer.X, answer.U, answer.response.error[0]

    first = export.export(jax.jit(prepare), platforms=PLATFORMS)(*like)
    leaves = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in first.out_avals]
    second = export.export(jax.jit(respond), platforms=PLATFORMS)(leaves, *like[:3])
    (folder / "prepare.jax").write_bytes(first.serialize())
    (folder / "respond.jax").write_bytes(second.serialize())
    write_text(folder / "mpc.json", json.dumps(_description(mpc, shapes), indent=1))
    return folder


def _shapes(N: int) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return shape and meaning of each argument."""
    return {
        "x": ((5,), "V [m/s], beta [rad], r [rad/s], offset e [m] and heading error theta [rad] from the path"),
        "command": ((2,), "last command: steering angle [rad], rear longitudinal force [N]"),
        "lagged_input": ((2,), "actuator outputs; the last command where there are no lags"),
        "reference": ((6, N + 1), "V, beta, r, e, theta to track, curvature of the path [1/m]"),
        "X": ((N + 1, 5), "states of the last plan; at first, of the reference"),
        "U": ((N, 2), "inputs of the last plan; at first, those of the reference"),
    }


def _description(mpc: DriftMPC, shapes: dict[str, tuple[tuple[int, ...], str]]) -> dict:
    arguments = {name: {"shape": list(shape), "meaning": meaning} for name, (shape, meaning) in shapes.items()}
    return {
        "what": "real-time iteration of a drift MPC, float64: set jax_enable_x64",
        "prepare": {"arguments": ["x", "command", "lagged_input", "reference", "X", "U"], "returns": "list of arrays"},
        "respond": {
            "arguments": ["what prepare returned", "x", "command", "lagged_input"],
            "returns": ["command", "X", "U", "error of the program, solved up to the tolerance"],
        },
        "arguments": arguments,
        "dt": float(mpc.ocp.dt),
        "horizon": mpc.horizon,
        "tolerance": float(mpc.options.tolerance),
    }
