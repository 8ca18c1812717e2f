"""Stored programs: loaded without tracing, keyed by shapes, static values and source, never the end of a call."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.parallel import call, clear_program_cache, compile_ahead, programs, source

traced: list[int] = []


def scaled(x, factor):
    traced.append(1)
    return factor * x


def applied(x, f):
    return f(x)


def times(factor: float):
    return lambda x: factor * x


def forget(monkeypatch):
    """As in another process."""
    monkeypatch.setattr(programs, "_programs", {})
    monkeypatch.setattr(programs, "_warned", threading.Event())


@pytest.fixture
def folder(empty_cache, monkeypatch):
    """An empty compilation cache, and no programs in this process."""
    forget(monkeypatch)
    traced.clear()
    return empty_cache


def test_a_stored_program_is_loaded_without_tracing(folder, monkeypatch):
    first = call(scaled, jnp.arange(3.0), 2)
    forget(monkeypatch)
    np.testing.assert_array_equal(call(scaled, jnp.arange(3.0), 2), first)
    assert len(traced) == 1


def test_other_shapes_types_and_static_values_are_other_programs(folder):
    assert float(call(scaled, jnp.arange(3.0), 2)[1]) == 2.0
    assert float(call(scaled, jnp.arange(3.0), 3)[1]) == 3.0
    assert call(scaled, jnp.arange(4.0), 3).shape == (4,)
    assert call(scaled, jnp.arange(4), 3).dtype == jnp.arange(4).dtype
    assert compile_ahead(scaled, jnp.arange(5.0), 3).shape == (5,)
    assert len(traced) == 5 == len(list((folder / "programs").iterdir()))


def test_an_integer_from_python_is_the_same_program_as_an_array(folder):
    weak, strong = jnp.asarray(3), jnp.asarray(np.array(4))
    assert weak.weak_type and not strong.weak_type
    assert [int(call(scaled, factor, jnp.arange(3))[1]) for factor in (weak, strong)] == [3, 4]
    assert len(traced) == 1


def test_arrays_put_on_the_default_device_are_the_same_program(folder):
    free = jnp.arange(3.0)
    placed = jax.device_put(free, jax.local_devices()[0])
    assert placed.committed and not free.committed
    np.testing.assert_array_equal(call(scaled, free, 2), call(scaled, placed, 2))
    assert len(traced) == 1 == len(programs._programs)


def test_what_prints_as_an_address_is_not_stored(folder):
    assert [float(call(applied, jnp.ones(()), times(k))) for k in (4.0, 5.0)] == [4.0, 5.0]
    assert not (folder / "programs").exists()


def test_a_function_within_a_function_is_refused():
    with pytest.raises(ValueError, match="module"):
        call(times(2.0), jnp.ones(()))


def test_programs_are_forgotten_where_they_are_many_and_come_back(folder):
    first = call(scaled, jnp.arange(3.0), 2)
    clear_program_cache(10**6)
    assert len(programs._programs) == 1
    clear_program_cache(0)
    assert not programs._programs
    np.testing.assert_array_equal(call(scaled, jnp.arange(3.0), 2), first)


def stored(folder: Path) -> list[Path]:
    return sorted((folder / "programs").iterdir())


@pytest.mark.parametrize("content", [b"", b"no pickle", b"\x80\x04N."])
def test_a_damaged_program_is_compiled_again_with_one_warning(folder, monkeypatch, content):
    call(scaled, jnp.arange(3.0), 2)
    call(scaled, jnp.arange(4.0), 2)
    for path in stored(folder):
        path.write_bytes(content)
    forget(monkeypatch)
    with pytest.warns(RuntimeWarning, match="compiled again") as warned:
        assert float(call(scaled, jnp.arange(3.0), 2)[1]) == 2.0
        assert float(call(scaled, jnp.arange(4.0), 2)[1]) == 2.0
    assert len(warned) == 1
    forget(monkeypatch)
    traced.clear()
    call(scaled, jnp.arange(3.0), 2)  # it was stored again
    assert not traced


@pytest.mark.parametrize("error", [PermissionError(13, "Permission denied"), OSError(28, "No space left on device")])
def test_a_folder_that_cannot_be_written_costs_a_warning_only(folder, monkeypatch, error):
    def fails(*_):
        raise error

    monkeypatch.setattr(programs, "write_atomically", fails)
    with pytest.warns(RuntimeWarning, match=error.strerror):
        assert float(call(scaled, jnp.arange(3.0), 2)[1]) == 2.0


def test_a_file_in_the_way_of_the_folder_costs_a_warning_only(folder):
    (folder / "programs").write_text("")
    with pytest.warns(RuntimeWarning, match="compiled again"):
        assert float(call(scaled, jnp.arange(3.0), 2)[1]) == 2.0


def test_a_program_of_another_user_is_not_loaded(folder, monkeypatch):
    call(scaled, jnp.arange(3.0), 2)
    forget(monkeypatch)
    monkeypatch.setattr(os, "getuid", lambda: os.stat(folder).st_uid + 1)
    with pytest.warns(RuntimeWarning, match="another user"):
        assert float(call(scaled, jnp.arange(3.0), 2)[1]) == 2.0
    assert len(traced) == 2


def test_programs_used_least_recently_are_deleted_beyond_the_limit(folder, monkeypatch):
    call(scaled, jnp.arange(3.0), 2)
    [first] = stored(folder)
    call(scaled, jnp.arange(3.0), 3)
    [second] = set(stored(folder)) - {first}
    for path, age in ((first, 200), (second, 100)):
        os.utime(path, (time.time() - age, time.time() - age))
    forget(monkeypatch)
    call(scaled, jnp.arange(3.0), 2)  # used again: the second is the older one now
    monkeypatch.setenv(programs.LIMIT, str(int(2.5 * first.stat().st_size)))
    call(scaled, jnp.arange(3.0), 4)
    assert first in stored(folder) and second not in stored(folder) and len(stored(folder)) == 2


def test_a_limit_that_is_no_number_is_bad_input(folder, monkeypatch):
    monkeypatch.setenv(programs.LIMIT, "1 GB")
    with pytest.raises(BadInput, match="DRIFTJAX_PROGRAM_CACHE_BYTES is '1 GB'"):
        call(scaled, jnp.arange(3.0), 2)


CHILD = """
import sys
import jax, jax.numpy as jnp
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
from driftjax.parallel import call
from own.module import Gain, applied
print(float(call(applied, jnp.ones(()), Gain())))
"""


def test_a_function_outside_the_package_is_stored_by_its_own_source(tmp_path):
    """An edit of the function, of a module that it imports or of an argument's type counts; one of others does not."""
    own, env = tmp_path / "own", os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(__file__).parents[2]}"}
    own.mkdir()

    def run(**sources: str) -> tuple[str, int]:
        for name, text in sources.items():
            (own / f"{name}.py").write_text(text)
        done = subprocess.run([sys.executable, "-c", CHILD, str(tmp_path / "cache")], env=env, capture_output=True,
                              text=True)  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout.strip(), len(stored(tmp_path / "cache"))

    module = "from own.gain import Gain\nfrom own.shift import SHIFT\n\ndef applied(x, g):\n    return g(x) + SHIFT\n"
    gain = "import equinox as eqx\n\nclass Gain(eqx.Module):\n    def __call__(self, x):\n        return 2 * x\n"
    assert run(module=module, gain=gain, shift="SHIFT = 1", other="") == ("3.0", 1)
    assert run(other="# an edit") == ("3.0", 1)
    assert run(module=module.replace("g(x)", "3 * g(x)")) == ("7.0", 2)
    assert run(shift="SHIFT = 2") == ("8.0", 3)
    assert run(gain=gain.replace("2 *", "4 *")) == ("14.0", 4)


def test_a_program_is_not_stored_where_its_source_changed_after_the_start(folder, monkeypatch):
    monkeypatch.setattr(source, "STARTED", os.stat(__file__).st_mtime - 1)
    call(scaled, jnp.arange(3.0), 2)
    assert not (folder / "programs").exists()


def test_programs_of_functions_that_are_named_are_optimised(folder, monkeypatch):
    given, compiled = [], jax.stages.Lowered.compile
    monkeypatch.setattr(
        jax.stages.Lowered, "compile", lambda one, options: given.append(options) or compiled(one, options)
    )
    monkeypatch.setenv(programs.OPTIMISED, "applied,scaled")
    assert float(call(scaled, jnp.arange(3.0), 2)[1]) == 2.0
    monkeypatch.setenv(programs.OPTIMISED, "applied")
    assert float(call(scaled, jnp.arange(4.0), 2)[1]) == 2.0
    assert given == [{"xla_backend_optimization_level": "3"}, None]


def test_of_two_processes_one_compiles_and_the_other_waits(tmp_path):
    """A lock of an open file holds between threads as between processes."""
    order, waits = [], threading.Event()

    def second() -> None:
        waits.set()
        with programs._file_lock(tmp_path / "programs" / "f-1"):
            order.append("second")

    thread = threading.Thread(target=second)
    with programs._file_lock(tmp_path / "programs" / "f-1"):
        thread.start()
        waits.wait()
        with programs._file_lock(tmp_path / "programs" / "f-2"):  # another program is not locked
            order.append("first")
    thread.join()
    assert order == ["first", "second"] and not list((tmp_path / "programs").iterdir())
