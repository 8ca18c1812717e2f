"""Translate a JAX function into a CasADi graph, so that one definition of the car serves both.

The jaxpr is evaluated on NumPy arrays whose entries are Python numbers, where they are known, or CasADi's symbols.
What depends on known numbers only, such as a delay in whole steps, is thereby computed beforehand.
"""

import itertools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import jax
import numpy as np
from jax import Array
from jax.extend.core import Literal

from driftjax.core import BadInput

Cells = np.ndarray  # of objects: numbers and casadi.SX scalars


def to_casadi(function: Callable[..., Array], *shapes: tuple[int, ...]) -> Callable[..., Cells]:
    """Return `function` of float64 arrays of these `shapes` as a function of arrays of CasADi symbols.

    It may branch and loop on known numbers only. Raises `BadInput` for an operation that has no counterpart.
    """
    closed = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes))

    def translated(*values: Cells) -> Cells:
        (output,) = _evaluate(closed.jaxpr, closed.consts, [np.asarray(value, object) for value in values])
        return output

    return translated


def _evaluate(jaxpr: Any, consts: Sequence[Any], values: Sequence[Cells]) -> list[Cells]:
    known: dict[Any, Cells] = dict(zip(jaxpr.constvars, map(_cells, consts), strict=True))
    known |= dict(zip(jaxpr.invars, values, strict=True))
    read = lambda atom: _cells(atom.val) if isinstance(atom, Literal) else known[atom]
    for eqn in jaxpr.eqns:
        outputs = _apply(eqn, [read(atom) for atom in eqn.invars])
        known |= dict(zip(eqn.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _cells(value: Any) -> Cells:
    return np.asarray(value).astype(object)


def _apply(eqn: Any, args: list[Cells]) -> list[Cells]:
    name, params = eqn.primitive.name, eqn.params
    if name in ELEMENTWISE:
        return [_elementwise(ELEMENTWISE[name], args)]
    if name in ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call"):
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        return _evaluate(inner.jaxpr, inner.consts, args)
    if name == "scan":
        return _scan(params, args)
    if name in SPECIAL:
        return SPECIAL[name](eqn, args)
    raise BadInput(f"casadi: the operation '{name}' of this car has no counterpart in CasADi; leave out its effect.")


def _elementwise(function: Callable[..., Any], args: list[Cells]) -> Cells:
    return np.asarray(np.frompyfunc(function, len(args), 1)(*args), object)


def _indexed(eqn: Any, args: list[Cells]) -> list[Cells]:
    """Apply an operation that selects entries by known indices, by applying it to their positions."""
    entries, *which = args
    if any(isinstance(index, ca.SX) for one in which for index in one.flat):
        raise BadInput(
            "casadi: an index depends on the state, which CasADi's graphs do not allow; leave out its effect."
        )
    at = np.arange(entries.size).reshape(entries.shape)
    positions = np.asarray(eqn.primitive.bind(at, *(one.astype(int) for one in which), **eqn.params))
    return [np.asarray(entries.ravel()[positions.ravel()], object).reshape(positions.shape)]


def _broadcast(eqn: Any, args: list[Cells]) -> list[Cells]:
    shape, kept = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    sizes = [args[0].shape[kept.index(axis)] if axis in kept else 1 for axis in range(len(shape))]
    return [np.broadcast_to(args[0].reshape(sizes), shape)]


def _slice(eqn: Any, args: list[Cells]) -> list[Cells]:
    starts, limits = eqn.params["start_indices"], eqn.params["limit_indices"]
    steps = eqn.params["strides"] or (1,) * len(starts)
    return [args[0][tuple(map(slice, starts, limits, steps))]]


def _split(eqn: Any, args: list[Cells]) -> list[Cells]:
    axis, starts = eqn.params["axis"], np.cumsum([0, *eqn.params["sizes"]])  # there may be no part
    return [args[0].take(np.arange(*ends), axis) for ends in itertools.pairwise(starts)]


def _reshape(eqn: Any, args: list[Cells]) -> list[Cells]:
    return [args[0].reshape(eqn.outvars[0].aval.shape)]


def _scan(params: dict[str, Any], args: list[Cells]) -> list[Cells]:
    consts, carried = params["num_consts"], params["num_carry"]
    fixed, state, rows = args[:consts], args[consts : consts + carried], args[consts + carried :]
    inner, order = params["jaxpr"], range(params["length"])
    outputs: list[list[Cells]] = []
    for k in reversed(order) if params["reverse"] else order:
        results = _evaluate(inner.jaxpr, inner.consts, [*fixed, *state, *(np.asarray(row[k], object) for row in rows)])
        state = results[:carried]
        outputs.append(results[carried:])
    if params["reverse"]:
        outputs.reverse()
    return [*state, *(np.stack(column) for column in zip(*outputs, strict=True))]


def _reduce(function: Callable[..., Any]) -> Callable[[Any, list[Cells]], list[Cells]]:
    def reduced(eqn: Any, args: list[Cells]) -> list[Cells]:
        return [np.asarray(np.frompyfunc(function, 2, 1).reduce(args[0], axis=tuple(eqn.params["axes"])), object)]

    return reduced


def _select(case: Any, *choices: Any) -> Any:
    if isinstance(case, ca.SX):
        return ca.if_else(case, choices[1], choices[0])
    return choices[int(case)]


def _integer_power(eqn: Any, args: list[Cells]) -> list[Cells]:
    return [_elementwise(lambda x: x ** eqn.params["y"], args)]


def _convert(eqn: Any, args: list[Cells]) -> list[Cells]:
    """Convert a type: only known numbers change."""
    kind = np.dtype(eqn.params["new_dtype"]).type
    return [_elementwise(lambda x: x if isinstance(x, ca.SX) else kind(x).item(), args)]


def _dot(eqn: Any, args: list[Cells]) -> list[Cells]:
    (left, right), (batch, _) = eqn.params["dimension_numbers"]
    if batch:
        raise BadInput("casadi: batched products have no counterpart in CasADi; leave out the effect that has one.")
    return [np.asarray(np.tensordot(args[0], args[1], (left, right)), object)]


ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "add": operator.add, "add_any": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
    "neg": operator.neg, "max": ca.fmax, "min": ca.fmin, "abs": ca.fabs, "sign": ca.sign, "floor": ca.floor,
    "ceil": ca.ceil, "sqrt": ca.sqrt, "rsqrt": lambda x: 1 / ca.sqrt(x), "exp": ca.exp, "log": ca.log,
    "log1p": ca.log1p, "expm1": ca.expm1, "tanh": ca.tanh, "sin": ca.sin, "cos": ca.cos, "tan": ca.tan,
    "atan": ca.atan, "arctan": ca.atan, "atan2": ca.atan2, "arctan2": ca.atan2, "square": lambda x: x * x,
    "logistic": lambda x: 1 / (1 + ca.exp(-x)), "pow": operator.pow, "rem": ca.fmod, "lt": operator.lt,
    "le": operator.le, "gt": operator.gt, "ge": operator.ge, "eq": operator.eq, "ne": operator.ne, "select_n": _select,
    "not": lambda x: ca.logic_not(x) if isinstance(x, ca.SX) else not x,
    "and": lambda x, y: ca.logic_and(x, y), "or": lambda x, y: ca.logic_or(x, y),
    "clamp": lambda low, x, high: ca.fmin(ca.fmax(x, low), high), "stop_gradient": lambda x: x, "copy": lambda x: x,
}  # fmt: skip
SPECIAL: dict[str, Callable[[Any, list[Cells]], list[Cells]]] = {
    "sincos": lambda eqn, args: [_elementwise(ca.sin, args), _elementwise(ca.cos, args)],
    "optimization_barrier": lambda eqn, args: args,
    "broadcast_in_dim": _broadcast,
    "reshape": _reshape,
    "squeeze": _reshape,
    "expand_dims": _reshape,
    "slice": _slice,
    "split": _split,
    "concatenate": lambda eqn, args: [np.concatenate(args, axis=eqn.params["dimension"])],
    "stack": lambda eqn, args: [np.stack(args, axis=eqn.params["axis"])],
    "transpose": lambda eqn, args: [args[0].transpose(eqn.params["permutation"])],
    "gather": _indexed,
    "dynamic_slice": _indexed,
    "convert_element_type": _convert,
    "integer_pow": _integer_power,
    "dot_general": _dot,
    "reduce_sum": _reduce(operator.add),
    "reduce_max": _reduce(ca.fmax),
    "reduce_min": _reduce(ca.fmin),
    "iota": lambda eqn, args: [_cells(eqn.primitive.bind(**eqn.params))],
}
