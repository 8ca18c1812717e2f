"""Importing the package sets up JAX or refuses: nothing computes in float32 silently, a chosen cache stays."""

import subprocess
import sys

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
for refused in (lambda: dj.simulate(dj.load_vehicle("rc"), [[0.0, 0.0]], 0.1), lambda: dj.fit_gp([[0.0]], [0.0])):
    try:
        refused()
    except RuntimeError as error:
        assert "setup()" in str(error), error
    else:
        raise AssertionError("computed in float32")
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
    done = subprocess.run([sys.executable, "-c", CHILD.format(cache=str(tmp_path))], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_help_needs_no_jax():
    child = "import sys; from driftjax.cli import main; main(['--help']); sys.exit('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", child], capture_output=True, text=True)
    assert done.returncode == 0 and "diagnose LOG" in done.stdout
