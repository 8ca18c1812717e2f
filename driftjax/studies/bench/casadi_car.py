"""What the CasADi peers share: the car written a second time, and generated C."""

import tempfile
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from typing import Any

import casadi as ca

from driftjax.vehicle import VehicleConfig

G = 9.81


def single_track(v: VehicleConfig, V, beta, r, delta, Fxr):
    """Rates of the published single track [SI], its rear side force within a friction ellipse where `v` has one."""
    L = v.a + v.b
    Fzf, Fzr = v.m * G * v.b / L, v.m * G * v.a / L
    vx, vy = V * ca.cos(beta), V * ca.sin(beta)
    shape = lambda alpha: ca.sin(v.C * ca.atan(v.B * alpha))
    Fyf = -v.mu * Fzf * shape(ca.atan2(vy + v.a * r, vx) - delta)
    Fyr = -v.mu * Fzr * shape(ca.atan2(vy - v.b * r, vx))
    if v.combined_slip:
        Fyr *= ca.sqrt(ca.fmax(1 - (v.combined_slip * Fxr / (v.mu * Fzr)) ** 2, 0.04))
    return (
        (-Fyf * ca.sin(delta - beta) + Fyr * ca.sin(beta) + Fxr * ca.cos(beta)) / v.m,
        (Fyf * ca.cos(delta - beta) + Fyr * ca.cos(beta) - Fxr * ca.sin(beta)) / (v.m * V) - r,
        (v.a * Fyf * ca.cos(delta) - v.b * Fyr) / v.Iz,
    )


@contextmanager
def generated(compiled: bool = True) -> Iterator[dict[str, Any]]:
    """Options that have CasADi write C and gcc compile it, for a solver made in this context; none if not `compiled`.

    CasADi writes its C where the process is, and clears it away where it thinks that it is: so it gets a folder of its
    own. The compiled code is loaded by the end.
    """
    if not compiled:
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix="driftjax-bench-") as folder, chdir(folder):
        gcc = {"flags": ["-O3"], "compiler": "gcc", "cleanup": False}
        yield {"jit": True, "compiler": "shell", "jit_options": gcc, "jit_cleanup": False}
