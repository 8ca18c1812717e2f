"""Elementary functions against NumPy in extended precision: values, edges, special arguments and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import elementary

TYPES = [np.float32, np.float64]
FAR = {np.float32: 1e4, np.float64: 1e6}  # largest argument of sine and cosine that keeps the stated error
PI = np.longdouble("3.14159265358979323846264338327950288")
FUNCTIONS = {
    "sin": (elementary.sin, np.sin),
    "sine of the pair": (lambda x: elementary.sincos(x)[0], np.sin),
    "cos": (elementary.cos, np.cos),
    "arctan": (elementary.arctan, np.arctan),
}


def units(value, exact):
    """Errors in units of the last place of the value's type."""
    value, place = np.asarray(value), np.spacing(np.abs(exact).astype(np.asarray(value).dtype))
    return np.abs(value.astype(np.longdouble) - exact) / place


def spread(kind, far, seed=0):
    """Arguments of every size up to `far`, both signs."""
    generator = np.random.default_rng(seed)
    flat, even = generator.uniform(-far, far, 50000), generator.uniform(-4, 4, 50000)
    sizes = np.exp(generator.uniform(-80, np.log(far), 50000)) * generator.choice([-1, 1], 50000)
    return np.concatenate([flat, even, sizes]).astype(kind)


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_to_the_last_places(name, kind):
    function, exact = FUNCTIONS[name]
    x = spread(kind, 1e30 if name == "arctan" else FAR[kind])
    value = jax.jit(function)(x)
    error = units(value, exact(x.astype(np.longdouble)))
    assert value.dtype == kind
    assert np.quantile(error, 0.999) < 2.5
    assert error.max() < 4


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_at_the_edges_of_the_reductions(name, kind):
    function, exact = FUNCTIONS[name]
    eighths = np.arange(-4000, 4001) * PI / 4
    edges = np.array([-1, 1, np.tan(PI / 8), 1 / np.tan(PI / 8)]) if name == "arctan" else eighths
    near = [edges.astype(kind)]
    for _ in range(3):
        near = [np.nextafter(near[0], kind(-np.inf)), *near, np.nextafter(near[-1], kind(np.inf))]
    x = np.concatenate(near)
    assert units(jax.jit(function)(x), exact(x.astype(np.longdouble))).max() < 4


@pytest.mark.parametrize("kind", TYPES)
def test_angles_of_points_to_the_last_places(kind):
    generator = np.random.default_rng(1)
    y, x = generator.normal(size=(2, 200000)) * np.exp(generator.uniform(-30, 30, (2, 200000)))
    y, x = y.astype(kind), x.astype(kind)
    exact = np.arctan2(y.astype(np.longdouble), x.astype(np.longdouble))
    assert units(jax.jit(elementary.arctan2)(y, x), exact).max() < 2.5


@pytest.mark.parametrize("kind", TYPES)
def test_angles_of_axes_zeros_and_infinities_are_those_of_ieee(kind):
    each = np.array([0.0, -0.0, 1, -1, 2.5, 1e30, -1e30, np.inf, -np.inf, np.nan], kind)
    y, x = np.meshgrid(each, each)
    value, exact = np.asarray(jax.jit(elementary.arctan2)(y, x)), np.arctan2(y, x)
    np.testing.assert_allclose(value, exact, rtol=3 * np.finfo(kind).eps, atol=0)
    finite = ~np.isnan(exact)
    np.testing.assert_array_equal(np.signbit(value)[finite], np.signbit(exact)[finite])
    one = np.asarray(jax.jit(elementary.arctan)(x))
    np.testing.assert_allclose(one, np.arctan(x), rtol=3 * np.finfo(kind).eps, atol=0)
    np.testing.assert_array_equal(np.signbit(one)[~np.isnan(x)], np.signbit(x)[~np.isnan(x)])


@pytest.mark.parametrize("kind", TYPES)
def test_sine_and_cosine_of_what_is_no_angle(kind):
    none = np.resize(np.array([np.inf, -np.inf, np.nan], kind), elementary.MIN_VECTOR_SIZE)
    sin, cos, sincos = map(jax.jit, (elementary.sin, elementary.cos, elementary.sincos))
    for value in (sin(none), cos(none), *sincos(none)):
        assert np.isnan(value).all()
    huge = np.resize(np.array([1e9, -1e15, 1e20, np.finfo(kind).max], kind), elementary.MIN_VECTOR_SIZE)
    for value in (sin(huge), *sincos(huge)):
        assert (np.abs(value) <= 1 + np.finfo(kind).eps).all()
    zeros = np.zeros(elementary.MIN_VECTOR_SIZE, kind)
    assert np.all(np.asarray(cos(zeros)) == 1) and np.all(np.asarray(sin(zeros)) == 0)


def test_far_angles_are_off_by_one_rounding_of_the_argument():
    x = np.random.default_rng(2).uniform(-1e12, 1e12, 10000)
    for value, exact in zip(jax.jit(elementary.sincos)(x), (np.sin(x), np.cos(x)), strict=True):
        assert (np.abs(value - exact) < np.spacing(np.abs(x))).all()


DERIVATIVES = {  # first and second derivative
    "sin": (np.cos, lambda x: -np.sin(x)),
    "sine of the pair": (np.cos, lambda x: -np.sin(x)),
    "cos": (lambda x: -np.sin(x), lambda x: -np.cos(x)),
    "arctan": (lambda x: 1 / (1 + x**2), lambda x: -2 * x / (1 + x**2) ** 2),
}


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_first_and_second_derivatives_forward_and_reverse(name, kind):
    function, (first, second) = FUNCTIONS[name][0], DERIVATIVES[name]
    x = np.linspace(-7, 7, 71, dtype=kind)  # with 0
    tolerance = {"rtol": 0, "atol": 8 * np.finfo(kind).eps}
    for order, exact in (((jax.grad,), first), ((jax.jacfwd,), first), ((jax.grad, jax.jacfwd), second),
                         ((jax.jacfwd, jax.grad), second), ((jax.grad, jax.grad), second)):  # fmt: skip
        derivative = function
        for take in order:
            derivative = take(derivative)
        value = jax.jit(jax.vmap(derivative))(x)
        assert value.dtype == kind
        np.testing.assert_allclose(value, exact(x.astype(float)), **tolerance)


def test_a_loop_is_differentiated_twice():
    def swung(x, sin, sincos, arctan, arctan2):
        def turn(a, share):
            s, c = sincos(a * share)
            return sin(a) + arctan(c) + arctan2(s, 1.5 + c), None

        return jax.lax.scan(turn, x[0] * x[1], np.arange(1.0, 4.0))[0]

    plain = (jnp.sin, lambda x: (jnp.sin(x), jnp.cos(x)), jnp.arctan, jnp.arctan2)
    ours = (elementary.sin, elementary.sincos, elementary.arctan, elementary.arctan2)
    x = np.array([0.3, 0.7])
    for take in (jax.hessian, lambda f: jax.jacrev(jax.jacrev(f)), lambda f: jax.jacfwd(jax.jacfwd(f))):
        expected = jax.jit(take(lambda x: swung(x, *plain)))(x)
        np.testing.assert_allclose(jax.jit(take(lambda x: swung(x, *ours)))(x), expected, rtol=1e-12)


@pytest.mark.parametrize("kind", TYPES)
def test_derivatives_of_angles_of_points(kind):
    y, x = np.random.default_rng(3).normal(size=(2, 100)).astype(kind)
    y[:2], x[2:4] = 0, 0
    squares = (x.astype(float) ** 2 + y.astype(float) ** 2)[:, None]
    exact = np.stack([x, -y], 1) / squares
    for take in (jax.jacfwd, jax.jacrev):
        value = np.stack(jax.jit(jax.vmap(take(elementary.arctan2, argnums=(0, 1))))(y, x), 1)
        assert value.dtype == kind
        np.testing.assert_allclose(value, exact, rtol=8 * np.finfo(kind).eps, atol=0)
    hessian = jax.jit(jax.vmap(jax.hessian(lambda z: elementary.arctan2(z[0], z[1]))))
    ours = np.asarray(hessian(np.stack([y, x], 1)))
    twice = -2 * x.astype(float) * y / squares[:, 0] ** 2
    largest = 1 / squares[:, 0]
    assert (np.abs(ours[:, 0, 0] - twice) <= 30 * np.finfo(kind).eps * largest).all()
    assert (np.abs(ours[:, 1, 1] + twice) <= 30 * np.finfo(kind).eps * largest).all()
    assert (np.abs(ours[:, 0, 1] - (y.astype(float) ** 2 - x**2) / squares[:, 0] ** 2)
            <= 30 * np.finfo(kind).eps * largest).all()  # fmt: skip


def test_types_mix_as_in_numpy_and_others_are_refused():
    assert elementary.sin(1).dtype == jnp.result_type(float)
    assert elementary.arctan2(np.float32(1), 2.0).dtype == np.float32
    assert elementary.arctan2(np.ones(3, np.float32), np.float64(2)).dtype == np.float64
    assert elementary.arctan2(np.ones((3, 1)), np.ones(2)).shape == (3, 2)
    with pytest.raises(TypeError, match="float16"):
        elementary.cos(np.float16(1))
    with pytest.raises(TypeError, match="complex"):
        elementary.sin(1j)


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("function", [elementary.sin, elementary.sincos, elementary.arctan])
def test_programs_of_many_numbers_hold_nothing_that_cannot_be_vectorised(function, batched):
    slow = ("sine", "cosine", "atan", "case", "while")

    def slow_operations(num):
        both = lambda x: jax.value_and_grad(lambda x: jnp.sum(jnp.asarray(function(x))))(x)
        text = jax.jit(jax.vmap(both) if batched else both).lower(jnp.ones(num)).as_text()
        return [op for op in slow if f"stablehlo.{op}" in text or f"chlo.{op}" in text]

    assert not slow_operations(elementary.MIN_VECTOR_SIZE)
    assert slow_operations(elementary.MIN_VECTOR_SIZE - 1)  # where XLA's own are as fast and less to compile


def test_batches_on_any_axis_are_those_of_numpy():
    y, x = np.random.default_rng(4).normal(size=(2, 5, 80))
    exact, over = np.arctan2(y, x), lambda *of: jax.jit(jax.vmap(*of))
    np.testing.assert_allclose(over(elementary.arctan2)(y, x), exact, rtol=1e-15)
    np.testing.assert_allclose(over(elementary.arctan2, (1, 1), 1)(y, x), exact, rtol=1e-15)
    np.testing.assert_allclose(over(elementary.arctan2, (1, 0), 1)(y, x.T), exact, rtol=1e-15)
    np.testing.assert_allclose(over(elementary.arctan2, (0, None))(y, x[0]), np.arctan2(y, x[0]), rtol=1e-15)
    np.testing.assert_allclose(over(elementary.sincos, 1, -1)(x), (np.sin(x), np.cos(x)), rtol=1e-12, atol=1e-16)
