"""The exported drift MPC: run by JAX alone, it gives the commands of `DriftMPC`."""

import json
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import driftjax as dj
from driftjax.control.mpc_solution import MPCPlan
from driftjax.core import Control
from driftjax.studies.bench.drift import U_REF, X_REF, car

ALONE = """
import json, sys
import numpy as np

class NoPackage:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in ("driftjax", "equinox"):
            raise ImportError(name)

sys.meta_path.insert(0, NoPackage())
import jax
from jax import export
jax.config.update("jax_enable_x64", True)
folder = sys.argv[1]
prepare, respond = (export.deserialize(open(f"{folder}/{half}.jax", "rb").read()) for half in ("prepare", "respond"))
given = np.load(f"{folder}/given.npz")
state = [given[name] for name in ("x", "command", "lagged_input")]
prepared = prepare.call(*state, given["reference"], given["X"], given["U"])
command, X, U, error = respond.call(prepared, given["measured"], *state[1:])
print(json.dumps({"platforms": prepare.platforms, "command": command.tolist(), "U": U.tolist(), "error": float(error)}))
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What the exported programs and the package answer."""
    mpc = dj.DriftMPC(car(), dj.MPCConfig(horizon=10))
    folder = dj.export_mpc(mpc, tmp_path_factory.mktemp("exported") / "mpc")
    reference = dj.steady_reference(X_REF[0], X_REF[1], X_REF[2], 10)
    x, command = np.array([*X_REF, 0.0, -X_REF[1]]), U_REF
    measured = x + [0.2, 0.02, -0.02, 0.0, 0.01]
    X, U = np.asarray(reference.states()), np.tile(U_REF, (10, 1))
    rows = np.stack([getattr(reference, name) for name in ("V", "beta", "r", "e", "theta", "kappa")])
    np.savez(
        folder / "given.npz", x=x, measured=measured, command=command, lagged_input=command, reference=rows, X=X, U=U
    )
    done = subprocess.run([sys.executable, "-c", ALONE, str(folder)], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    last = MPCPlan(Control(*jnp.asarray(U[0])), jnp.asarray(X), jnp.asarray(U))
    prepared = mpc.prepare(dj.mpc_state(x, command), reference, last)
    return folder, json.loads(done.stdout), mpc.respond(prepared, dj.mpc_state(measured, command))


def test_jax_alone_gives_the_same_command(answers):
    _, exported, own = answers
    np.testing.assert_allclose(exported["command"], [own.u.delta, own.u.Fxr], rtol=1e-9)
    np.testing.assert_allclose(exported["U"], own.U, rtol=1e-9)
    assert exported["error"] <= 1e-4


def test_the_programs_run_on_cpu_and_cuda_and_say_their_arguments(answers):
    folder, exported, _ = answers
    assert exported["platforms"] == ["cpu", "cuda"]
    said = json.loads((folder / "mpc.json").read_text())
    given = np.load(folder / "given.npz")
    assert {name: list(given[name].shape) for name in said["arguments"]} == {
        name: value["shape"] for name, value in said["arguments"].items()
    }
