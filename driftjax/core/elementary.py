"""Sine, cosine and arc tangent without branches, which XLA's CPU compiler turns into vector instructions.

By default the compiler calls the C library once per number, for `jnp.arctan2` in float32 too. Here each function is a
reduction of the argument and a polynomial where there are many numbers. Where there are few, which would gain nothing
and be more to compile, and on other devices than CPUs, it is XLA's own function. Their number is known once all batches
are: each function is a primitive.

float32 and float64 keep their type. Errors stay below 2.5 units in the last place, 4 next to far zeros, for sine and
cosine up to an argument of 1e4 (float32) or 1e6 (float64); beyond, they grow as if the argument had been rounded once
more, and values stay within one. NaN and infinite arguments give what NumPy gives; sine gives +0 at -0.

The polynomials have the smallest largest relative error (Remez' algorithm, computed for this file in 50 digits with
mpmath); the reductions are those of Cody and Waite (1980), with pi/2 split as in fdlibm's `e_rem_pio2.c` (Sun
Microsystems 1993) for float64.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.typing import ArrayLike

MIN_VECTOR_SIZE = 64  # numbers below which a polynomial gains nothing


class _Table(NamedTuple):
    """Constants of one precision; polynomials in the square of the argument, lowest order first."""

    half_pi: tuple[float, ...]  # pi/2 in parts, whose products with the number of quarter turns are exact
    sin_half: tuple[float, ...]  # (sin(r)/r - 1)/r^2 for |r| <= pi/2
    sin: tuple[float, ...]  # the same for |r| <= pi/4
    cos: tuple[float, ...]  # (cos(r) - 1 + r^2/2)/r^4 for |r| <= pi/4
    arctan: tuple[float, ...]  # (arctan(t)/t - 1)/t^2 for |t| <= tan(pi/8)
    quarter_pi: tuple[float, float]  # pi/4, and what its rounding leaves
    bits: type  # signed integer of the same size


_FLOAT32 = _Table(
    half_pi=(1.5703125, 0.0004839897155761719, -1.628650352358818e-07, -5.564431554416771e-11),
    sin_half=(-0.1666665954457383, 0.008333066082668827, -0.00019809590097833935, 2.6057506884334894e-06),
    sin=(-0.1666666640776, 0.00833332930241395, -0.00019839311484227165, 2.7181141064586573e-06),
    cos=(0.04166664567020031, -0.0013887315618198867, 2.4433082842772354e-05),
    arctan=(-0.3333331517180347, 0.19998470406261457, -0.14243511032441702, 0.10593639570817627, -0.060777585622318414),
    quarter_pi=(0.7853981852531433, -2.1855695000931213e-08),
    bits=np.int32,
)
_FLOAT64 = _Table(
    half_pi=(1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21),
    sin_half=(
        -0.16666666666666666, 0.008333333333333194, -0.00019841269841209145, 2.755731921112434e-06,
        -2.505210687158711e-08, 1.6058939643320004e-10, -7.64298982350973e-13, 2.7211570454903752e-15,
    ),
    sin=(
        -0.1666666666666663, 0.008333333333322108, -0.00019841269829580182, 2.755731361802219e-06,
        -2.5050747218841437e-08, 1.5896197667703675e-10,
    ),
    cos=(
        0.041666666666666595, -0.001388888888887304, 2.4801587288841428e-05, -2.7557314176245346e-07,
        2.08757004165151e-09, -1.1358513961729912e-11,
    ),
    arctan=(
        -0.333333333333332, 0.19999999999953164, -0.14285714280157585, 0.11111110781687242, -0.09090897711311671,
        0.07692059461557377, -0.06663096212797812, 0.05847836955268527, -0.05039087534306469, 0.03805947022569205,
        -0.017902058634683415,
    ),
    quarter_pi=(0.7853981633974483, 3.061616997868383e-17),
    bits=np.int64,
)  # fmt: skip
_TABLES = {np.dtype("float32"): _FLOAT32, np.dtype("float64"): _FLOAT64}


def sin(x: ArrayLike) -> Array:
    """Return the sine of `x` [rad]; half the work of `sincos`."""
    return _sin(*_floats(x))


def cos(x: ArrayLike) -> Array:
    """Return the cosine of `x` [rad]."""
    return _sincos(*_floats(x))[1]


def sincos(x: ArrayLike) -> tuple[Array, Array]:
    """Return the sine and cosine of `x` [rad], which share most of their work."""
    return tuple(_sincos(*_floats(x)))


def arctan(x: ArrayLike) -> Array:
    """Return the arc tangent of `x` [rad], in [-pi/2, pi/2]."""
    return _arctan(*_floats(x))


def arctan2(y: ArrayLike, x: ArrayLike) -> Array:
    """Return the angle of the point (`x`, `y`) [rad] in [-pi, pi]; signed zeros and infinities follow IEEE 754.

    Coordinates beyond half the largest number overflow. At the origin the value is finite and the derivative NaN.
    """
    return _arctan2(*_floats(y, x))


def _floats(*values: ArrayLike) -> list[Array]:
    """Return the arguments as arrays of one floating type, float32 or float64."""
    kind = jnp.result_type(*values)
    if not jnp.issubdtype(kind, jnp.floating):
        kind = jnp.result_type(float) if jnp.issubdtype(kind, jnp.integer) else kind
    if kind not in _TABLES:
        raise TypeError(f"angles are float32 or float64, not {kind}")
    return jnp.broadcast_arrays(*(jnp.asarray(value, kind) for value in values))


def _polynomial(z: Array, coefficients: tuple[float, ...]) -> Array:
    """Return sum_i c_i z^i by Estrin's scheme, whose chain of dependent operations is short."""
    terms: list[Array | float] = list(coefficients)
    while len(terms) > 1:
        pairs = zip(terms[::2], [*terms[1::2], *[None] * (len(terms) % 2)], strict=True)
        terms = [low if high is None else low + high * z for low, high in pairs]
        z = z * z
    return jnp.asarray(terms[0])


def _reduced(x: Array, quarters: Array, table: _Table) -> Array:
    """Return `x` less `quarters` quarter turns; 0 if `x` is too large to be an angle."""
    r = x
    for part in table.half_pi:
        r = r - quarters * part
    return jnp.where(jnp.abs(r) < 1.6, r, 0 * r)


def _odd(x: Array, coefficients: tuple[float, ...]) -> Array:
    """Return x + x^3 p(x^2)."""
    z = x * x
    return x + x * z * _polynomial(z, coefficients)


def _polynomial_of_sin(x: Array) -> Array:
    table = _TABLES[x.dtype]
    half_turns = lax.round(x * (1 / math.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    parity = half_turns / 2 - jnp.floor(half_turns / 2)  # 0, or 1/2 for an odd number
    return _odd(_reduced(x, 2 * half_turns, table) * (1 - 4 * parity), table.sin_half)


def _polynomial_of_sincos(x: Array) -> tuple[Array, Array]:
    table = _TABLES[x.dtype]
    quarters = lax.round(x * (2 / math.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    turns = quarters / 4 - jnp.floor(quarters / 4)  # 0, 1/4, 1/2 or 3/4
    r = _reduced(x, quarters, table)
    z = r * r
    along, across = _odd(r, table.sin), 1 - z / 2 + z * z * _polynomial(z, table.cos)
    odd = (turns == 0.25) | (turns == 0.75)
    s, c = jnp.where(odd, across, along), jnp.where(odd, along, across)
    return jnp.where(turns >= 0.5, -s, s), jnp.where((turns == 0.25) | (turns == 0.5), -c, c)


def _octant(small: Array, large: Array, table: _Table) -> tuple[Array, Array]:
    """Return arctan(small / large), 0 <= small <= large, as an angle and the number of times pi/4 to add to it."""
    infinite = small == jnp.inf  # both are
    beyond = infinite | (small > math.tan(math.pi / 8) * large)
    top = jnp.where(infinite, 0, jnp.where(beyond, small - large, small))
    bottom = jnp.where(beyond, small + large, jnp.where(large == 0, 1, large))
    return _odd(top / bottom, table.arctan), jnp.where(beyond, jnp.ones_like(small), jnp.zeros_like(small))


def _turned(angle: Array, eighths: Array, table: _Table) -> Array:
    """Return `angle` + `eighths` pi/4."""
    high, low = table.quarter_pi
    return eighths * high + (angle + eighths * low)


def _signed(size: Array, like: Array, table: _Table) -> Array:
    """Return `size` >= 0 with the sign of `like`, including signed zeros."""
    bits, least = lambda a: lax.bitcast_convert_type(a, table.bits), np.iinfo(table.bits).min
    return lax.bitcast_convert_type(bits(size) | (bits(like) & least), size.dtype)


def _polynomial_of_arctan(x: Array) -> Array:
    table, size = _TABLES[x.dtype], jnp.abs(x)
    steep = size > 1
    angle, eighths = _octant(jnp.where(steep, 1, size), jnp.where(steep, size, 1), table)
    angle, eighths = jnp.where(steep, -angle, angle), jnp.where(steep, 2 - eighths, eighths)
    return _signed(_turned(angle, eighths, table), x, table)


def _polynomial_of_arctan2(y: Array, x: Array) -> Array:
    table, high, wide = _TABLES[x.dtype], jnp.abs(y), jnp.abs(x)
    steep = high > wide
    angle, eighths = _octant(jnp.where(steep, wide, high), jnp.where(steep, high, wide), table)
    angle, eighths = jnp.where(steep, -angle, angle), jnp.where(steep, 2 - eighths, eighths)
    back = lax.bitcast_convert_type(x, table.bits) < 0
    angle, eighths = jnp.where(back, -angle, angle), jnp.where(back, 4 - eighths, eighths)
    return _signed(_turned(angle, eighths, table), y, table)


def _elementwise(name: str, polynomial: Callable[..., Any], own: Callable[..., Any], slope: Callable[..., Any]) -> Any:
    """Return a primitive of arrays of one shape and type, compiled as `polynomial` or as XLA's `own` function.

    `slope(primals, tangents)` are its values and their derivatives. A rule of the primitive itself, unlike that of a
    `custom_jvp`, is not lost where a loop is differentiated twice.
    """
    primitive = Primitive(name)
    several = primitive.multiple_results = name == "sincos"

    def lowered(context: Any, *operands: Any) -> Any:
        few = math.prod(context.avals_in[0].shape) < MIN_VECTOR_SIZE
        # without the barrier XLA computes a polynomial again for each of its uses
        once = lambda *x: lax.optimization_barrier(polynomial(*x))
        return mlir.lower_fun(own if few else once, multiple_results=several)(context, *operands)

    def batched(args: Any, axes: Any) -> Any:
        size = next(a.shape[axis] for a, axis in zip(args, axes, strict=True) if axis is not None)
        front = [jnp.broadcast_to(a, (size, *a.shape)) if axis is None else jnp.moveaxis(a, axis, 0)
                 for a, axis in zip(args, axes, strict=True)]  # fmt: skip
        return primitive.bind(*front), (0, 0) if several else 0

    def shaped(*shapes: Any) -> Any:
        one = ShapedArray(shapes[0].shape, shapes[0].dtype)
        return [one, one] if several else one

    primitive.def_abstract_eval(shaped)
    primitive.def_impl(jax.jit(primitive.bind))
    ad.primitive_jvps[primitive] = lambda primals, tangents: slope(primals, map(ad.instantiate_zeros, tangents))
    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, mlir.lower_fun(own, multiple_results=several))
    mlir.register_lowering(primitive, lowered, platform="cpu")
    return primitive.bind


def _slope_of_sin(primals, tangents):
    s, c = _sincos(*primals)
    return s, c * next(tangents)


def _slope_of_sincos(primals, tangents):
    (s, c), dx = _sincos(*primals), next(tangents)
    return [s, c], [c * dx, -s * dx]


def _slope_of_arctan(primals, tangents):
    (x,) = primals
    return _arctan(x), next(tangents) / (1 + x * x)


def _slope_of_arctan2(primals, tangents):
    (y, x), (dy, dx) = primals, tangents
    return _arctan2(y, x), (x * dy - y * dx) / (x * x + y * y)


_sin = _elementwise("sin", _polynomial_of_sin, jnp.sin, _slope_of_sin)
_sincos = _elementwise("sincos", _polynomial_of_sincos, lambda x: (jnp.sin(x), jnp.cos(x)), _slope_of_sincos)
_arctan = _elementwise("arctan", _polynomial_of_arctan, jnp.arctan, _slope_of_arctan)
_arctan2 = _elementwise("arctan2", _polynomial_of_arctan2, jnp.arctan2, _slope_of_arctan2)
