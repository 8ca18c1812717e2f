"""Importing the package sets up JAX or refuses: nothing computes in float32 silently, a chosen cache stays."""

import os
import subprocess
import sys

import driftjax as dj
from driftjax.environment import BARRIERS, SERIAL_LOOPS, with_pass, without_passes

COMPUTING = ["simulate", "drive_laps", "build_car", "equilibria", "plan", "DriftMPC", "fit_gp", "fit_kernel", "learn",
             "tune_mpc", "record_runs", "diagnose", "calibrate", "compare", "export_car", "fit_tir",
             "magic_formula"]  # fmt: skip

CHILD = """
import sys
import jax, jax.numpy as jnp
jax.config.update("jax_compilation_cache_dir", {cache!r})
assert jnp.ones(1).dtype == "float32"
import warnings
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import driftjax as dj
assert any("NPROC" in str(one.message) for one in caught), caught  # JAX had started, with its own threads
assert jnp.ones(1).dtype == "float64" and jax.config.values["jax_compilation_cache_dir"] == {cache!r}
jax.config.update("jax_enable_x64", False)
import inspect
for name in {computing}:
    function = getattr(dj, name)
    required = [p for p in inspect.signature(function).parameters.values() if p.default is p.empty]
    try:
        function(*(None for p in required if p.kind is p.POSITIONAL_OR_KEYWORD),
                 **{{p.name: None for p in required if p.kind is p.KEYWORD_ONLY}})
    except RuntimeError as error:
        assert "setup()" in str(error), error
    else:
        raise AssertionError(name + " computed in float32")
try:
    dj.setup(threads=3)
except RuntimeError as error:
    assert "before anything computes" in str(error), error
else:
    raise AssertionError("threads were changed under a running client")
dj.setup()
assert jnp.ones(1).dtype == "float64"
"""


def test_float64_is_set_up_or_its_absence_refused(tmp_path, monkeypatch):
    for name in ("NPROC", "JAX_ENABLE_X64", "XLA_FLAGS"):
        monkeypatch.delenv(name, raising=False)
    done = subprocess.run(
        [sys.executable, "-c", CHILD.format(cache=str(tmp_path), computing=COMPUTING)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_passes_are_disabled_by_one_flag_beside_others():
    flags = without_passes(without_passes("--a=1 --xla_disable_hlo_passes=b", *BARRIERS), SERIAL_LOOPS)
    assert flags == f"--a=1 --xla_disable_hlo_passes=b,{','.join(BARRIERS)},{SERIAL_LOOPS}"
    assert without_passes(flags, *BARRIERS) == flags
    assert with_pass(with_pass(flags, "b"), SERIAL_LOOPS) == f"--a=1 --xla_disable_hlo_passes={','.join(BARRIERS)}"
    assert with_pass("--a=1 --xla_disable_hlo_passes=b", "b") == "--a=1"


def test_barriers_stay_on_a_machine_with_cpus_only(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    for plugins, expected in ((None, True), ("found", False)):
        monkeypatch.setattr("importlib.util.find_spec", lambda name, found=plugins: found)
        monkeypatch.setenv("XLA_FLAGS", "")
        dj.setup()
        assert all((name in os.environ["XLA_FLAGS"]) == expected for name in BARRIERS)


def test_help_needs_no_jax():
    child = "import sys; from driftjax.cli import main; main(['--help']); sys.exit('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", child], capture_output=True, text=True)
    assert done.returncode == 0 and "diagnose LOG" in done.stdout
