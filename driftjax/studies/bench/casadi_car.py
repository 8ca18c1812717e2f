"""Shared by the CasADi peers: an independent implementation of the car, and generated C."""

import tempfile
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from typing import Any

import casadi as ca

from driftjax.vehicle import VehicleConfig

G = 9.81


def single_track(v: VehicleConfig, V, beta, r, delta, Fxr):
    """Return the rates of the published single track [SI], with the friction ellipse of `v` at the rear, if any."""
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
    """Yield the options with which CasADi generates C and gcc compiles it; none if not `compiled`.

    The solver must be created in this context. CasADi writes its C into the working directory, so it gets a temporary
    one; the compiled code is loaded by the end.
    """
    if not compiled:
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix="driftjax-bench-") as folder, chdir(folder):
        gcc = {"flags": ["-O3"], "compiler": "gcc", "cleanup": False}
        yield {"jit": True, "compiler": "shell", "jit_options": gcc, "jit_cleanup": False}
