"""Kept programs: found again without tracing, told apart by shapes and static values, not kept where unsafe."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from driftjax.core.programs import call, let_go, prepare

from driftjax.core import programs

traced: list[int] = []


def scaled(x, factor):
    traced.append(1)
    return factor * x


def applied(x, f):
    return f(x)


def times(factor: float):
    return lambda x: factor * x


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty compilation cache."""
    monkeypatch.setattr(programs, "_programs", {})
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    traced.clear()
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def test_a_kept_program_is_found_again_without_tracing(folder, monkeypatch):
    first = call(scaled, jnp.arange(3.0), 2)
    monkeypatch.setattr(programs, "_programs", {})  # as in another process
    np.testing.assert_array_equal(call(scaled, jnp.arange(3.0), 2), first)
    assert len(traced) == 1


def test_other_shapes_types_and_static_values_are_other_programs(folder):
    assert float(call(scaled, jnp.arange(3.0), 2)[1]) == 2.0
    assert float(call(scaled, jnp.arange(3.0), 3)[1]) == 3.0
    assert call(scaled, jnp.arange(4.0), 3).shape == (4,)
    assert call(scaled, jnp.arange(4), 3).dtype == jnp.arange(4).dtype
    assert prepare(scaled, jnp.arange(5.0), 3).shape == (5,)
    assert len(traced) == 5 == len(list((folder / "programs").iterdir()))


def test_what_prints_as_an_address_is_not_kept(folder):
    assert [float(call(applied, jnp.ones(()), times(k))) for k in (4.0, 5.0)] == [4.0, 5.0]
    assert not (folder / "programs").exists()


def test_a_function_within_a_function_is_refused():
    with pytest.raises(ValueError, match="module"):
        call(times(2.0), jnp.ones(()))


def test_programs_are_given_up_where_they_are_many_and_come_back(folder):
    first = call(scaled, jnp.arange(3.0), 2)
    let_go()
    assert len(programs._programs) == 1
    let_go(0)
    assert not programs._programs
    np.testing.assert_array_equal(call(scaled, jnp.arange(3.0), 2), first)
