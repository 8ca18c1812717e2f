"""Compile long elementwise expressions without computing anything twice.

XLA fuses elementwise operations by computing a value again for each of its users, which in the derivatives of a car
costs several times the work they hold. `compute_once` computes each value once and keeps it where it is used twice.
"""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jax import Array

P = ParamSpec("P")
T = TypeVar("T")

# cheaper to do again for each user than to write and read
FREE = {"broadcast_in_dim", "neg", "copy", "reshape", "squeeze", "slice", "convert_element_type", "stop_gradient"}


def compute_once(function: Callable[P, T]) -> Callable[P, T]:
    """Return `function` with no repeated operation and every shared array computed once."""

    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        flat, structure = jax.tree.flatten((args, kwargs))
        shape: Any = None

        def leaves(*flat: Array) -> list:
            nonlocal shape
            args, kwargs = jax.tree.unflatten(structure, flat)
            out, shape = jax.tree.flatten(function(*args, **kwargs))  # pyright: ignore[reportCallIssue]
            return out

        closed = jax.make_jaxpr(leaves)(*flat)
        closed = jax.make_jaxpr(lambda *flat: _inlined(closed.jaxpr, closed.consts, *flat))(*flat)
        return jax.tree.unflatten(shape, _once(closed.jaxpr, closed.consts, *flat))

    return run


def _called(eqn: Any) -> Any:
    """Return the program that an equation only calls; None if it computes something itself."""
    if eqn.primitive.name in ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call"):
        return next(eqn.params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in eqn.params)
    return None


def bind(eqn: Any, values: list) -> list:
    """Evaluate one equation of a program for these inputs."""
    out = eqn.primitive.bind(*values, **eqn.params)
    return list(out) if eqn.primitive.multiple_results else [out]


def _inlined(jaxpr: Any, consts: Any, *args: Array) -> list:
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))
    read = lambda v: v.val if isinstance(v, jex.Literal) else known[v]
    for eqn in jaxpr.eqns:
        values, inner = [read(v) for v in eqn.invars], _called(eqn)
        if inner is None:
            out = bind(eqn, values)
        elif isinstance(inner, jex.ClosedJaxpr):
            out = _inlined(inner.jaxpr, inner.consts, *values)
        else:
            out = _inlined(inner, (), *values)
        known.update(zip(eqn.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _once(jaxpr: Any, consts: Any, *args: Array) -> list:
    """Evaluate without repeated operations, with a barrier after each array that has several users."""
    same, kept = {}, []  # variable to the first of its kind; equations that remain
    first: dict[Any, Any] = {}
    name = lambda v: repr(v.val) + str(v.aval) if isinstance(v, jex.Literal) else same.get(v, v)
    for eqn in jaxpr.eqns:
        key = (eqn.primitive, tuple(map(name, eqn.invars)), repr(sorted(eqn.params.items(), key=lambda p: p[0])))
        if not eqn.effects and key in first:
            same.update(zip(eqn.outvars, first[key], strict=True))
        else:
            first[key] = eqn.outvars
            kept.append(eqn)
    users: dict[Any, int] = {}
    for v in [v for eqn in kept for v in eqn.invars] + list(jaxpr.outvars):
        if not isinstance(v, jex.Literal):
            users[same.get(v, v)] = users.get(same.get(v, v), 0) + 1
    store = lambda v, x: jax.lax.optimization_barrier(x) if users.get(v, 0) > 1 and jnp.ndim(x) else x
    given = zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True)
    known = {v: store(v, value) for v, value in given}
    read = lambda v: v.val if isinstance(v, jex.Literal) else known[same.get(v, v)]
    for eqn in kept:
        out = zip(eqn.outvars, bind(eqn, [read(v) for v in eqn.invars]), strict=True)
        known.update((v, value if eqn.primitive.name in FREE else store(v, value)) for v, value in out)
    return [read(v) for v in jaxpr.outvars]
