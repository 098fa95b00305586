"""Against Python's fractions, which round nothing."""

import functools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
from tables import rows

from cpjax.numeric import double_word as dw
from cpjax.numeric.double_word import DoubleWord, double_word, two_product, two_sum

COUNT = 1000
DTYPES = rows("dtype", [np.float64, np.float32])
MODES = {"eager": lambda f: f, "jit": jax.jit, "vmap": jax.vmap, "vmap in jit": lambda f: jax.jit(jax.vmap(f))}
EVERY_MODE = rows("mode", MODES)
EXACT = {"add": Fraction.__add__, "multiply": Fraction.__mul__, "divide": Fraction.__truediv__}


def plain(x):
    return [Fraction(float(v)) for v in np.ravel(x)]


def exact(x):
    return [high + low for high, low in zip(plain(x.high), plain(x.low), strict=True)]


def eps(dtype):
    return Fraction(float(np.finfo(dtype).eps))


@functools.cache
def floats(dtype, seed, spread=20):
    """Floats of random sign, with random, all-one and one-bit mantissas, over many powers of two."""
    rng = np.random.default_rng(seed)
    ulp = np.finfo(dtype).eps
    mantissas = np.where(rng.random(COUNT) < 0.5, 1.0 + rng.random(COUNT), 2.0 - ulp)
    mantissas = np.where(rng.random(COUNT) < 0.2, 1.0 + ulp, mantissas)
    return (rng.choice([-1.0, 1.0], COUNT) * mantissas * 2.0 ** rng.integers(-spread, spread, COUNT)).astype(dtype)


@functools.cache
def double_words(dtype, seed):
    high = floats(dtype, seed)
    low = floats(dtype, seed + 100, spread=1) * np.abs(high) * np.finfo(dtype).eps / dtype(8)
    low[::10] = 0.0
    return DoubleWord(*(np.asarray(x) for x in two_sum(jnp.asarray(high), jnp.asarray(low.astype(dtype)))))


@DTYPES
@EVERY_MODE
def test_a_sum_of_two_floats_loses_nothing(dtype, mode):
    a, b = floats(dtype, 0), floats(dtype, 1)
    pairs = [(a, b), (a, -np.nextafter(a, dtype(0))), (a, np.zeros_like(a)), (a, -a), (np.ones_like(a), b)]
    for a, b in pairs:
        total = MODES[mode](two_sum)(jnp.asarray(a), jnp.asarray(b))
        assert exact(total) == [x + y for x, y in zip(plain(a), plain(b), strict=True)]
        assert np.array_equal(total.high, a + b)


@DTYPES
@EVERY_MODE
def test_a_product_of_two_floats_is_right_to_four_units_of_eps_squared(dtype, mode):
    # The halves of 53 digits have 26 and 27; the product of two low halves is rounded, and so are three sums.
    a, b = floats(dtype, 0), floats(dtype, 1)
    product = MODES[mode](two_product)(jnp.asarray(a), jnp.asarray(b))
    right = [x * y for x, y in zip(plain(a), plain(b), strict=True)]
    assert max(abs(x / y - 1) for x, y in zip(exact(product), right, strict=True)) <= 4 * eps(dtype) ** 2


@DTYPES
@EVERY_MODE
@rows("name", EXACT)
def test_the_error_of_an_operation_is_within_six_units_of_eps_squared(dtype, mode, name):
    x, y = double_words(dtype, 2), double_words(dtype, 3)
    opposite = DoubleWord(-np.nextafter(x.high, dtype(0)), x.low)  # a sum with y that cancels almost altogether
    for other in (y, opposite) if name == "add" else (y,):
        found = MODES[mode](getattr(dw, name))(*jax.tree.map(jnp.asarray, (x, other)))
        for value, a, b in zip(exact(found), exact(x), exact(other), strict=True):
            right = EXACT[name](a, b)
            assert abs(value - right) <= 6 * eps(dtype) ** 2 * (abs(a) + abs(b) if name == "add" else abs(right))
        # What is a double word: the low one is less than rounding leaves of the high one.
        assert np.all(np.abs(found.low) <= np.abs(found.high) * (np.finfo(dtype).eps / 2))
        assert found.high.dtype == found.low.dtype == dtype


@DTYPES
@rows("mode", list(MODES)[1:])
@rows("operation", [two_sum, two_product], ids=lambda f: f.__name__)
def test_a_compiler_changes_no_bit_of_the_operations_that_all_others_are_made_of(dtype, mode, operation):
    a, b = jnp.asarray(floats(dtype, 0)), jnp.asarray(floats(dtype, 1))
    for x, y in zip(operation(a, b), MODES[mode](operation)(a, b), strict=True):
        assert np.array_equal(x, y)


@DTYPES
@EVERY_MODE
def test_a_sum_with_a_constant_of_the_program_loses_nothing(dtype, mode):
    # A compiler that knows c would like to make x of (c + x) - c.
    x = np.linspace(0.1, 1.0, 50).astype(dtype) * dtype(1e-5)
    for c in (1.0, 1.3, -1.0):
        constant = np.full_like(x, c)
        for operation in (two_sum, lambda x, y: dw.add(double_word(x), double_word(y))):
            for total in (
                MODES[mode](lambda x, f=operation, c=constant: f(jnp.full_like(x, c.flat[0]), x))(jnp.asarray(x)),
                MODES[mode](lambda x, f=operation, c=constant: f(x, jnp.full_like(x, c.flat[0])))(jnp.asarray(x)),
            ):
                assert exact(total) == [a + b for a, b in zip(plain(x), plain(constant), strict=True)]


@DTYPES
@EVERY_MODE
def test_digits_that_plain_floats_lose_by_cancellation_are_kept(dtype, mode):
    def rest(x, one):
        """What is left of (1 + x) (1 - x) - 1 + x^2, in which plain floats have no digit of x^2."""
        above, below = two_sum(one, x), two_sum(one, -x)
        return dw.add(dw.add(dw.multiply(above, below), dw.negative(double_word(one))), two_product(x, x))

    x = (np.linspace(0.1, 1.0, 50) * np.finfo(dtype).eps ** 0.75).astype(dtype)
    assert np.all(x * x < np.finfo(dtype).eps / 2)
    left = exact(MODES[mode](rest)(jnp.asarray(x), jnp.ones_like(x)))
    assert max(map(abs, left)) <= 6 * eps(dtype) ** 2


@DTYPES
def test_a_number_less_itself_is_zero_and_over_itself_is_one(dtype):
    x = jax.tree.map(jnp.asarray, double_words(dtype, 4))
    assert exact(dw.add(x, dw.negative(x))) == [Fraction(0)] * COUNT
    assert max(abs(q - 1) for q in exact(dw.divide(x, x))) <= 2 * eps(dtype) ** 2


@DTYPES
def test_a_third_times_three_is_one(dtype):
    one, three = double_word(jnp.ones((), dtype)), double_word(jnp.full((), 3, dtype))
    [error] = exact(dw.add(dw.multiply(dw.divide(one, three), three), dw.negative(one)))
    assert abs(error) <= 6 * eps(dtype) ** 2


@DTYPES
def test_powers_of_two_move_no_digit(dtype):
    x, y = (jax.tree.map(jnp.asarray, double_words(dtype, seed)) for seed in (5, 6))
    large = jax.tree.map(lambda v: v * dtype(2.0**30), x)
    for operation in (dw.multiply, dw.divide):
        for plainly, scaled in zip(operation(x, y), operation(large, y), strict=True):
            assert np.array_equal(plainly * dtype(2.0**30), scaled)


@DTYPES
@rows("bad", [np.nan, np.inf])
def test_what_is_not_finite_stays_so(dtype, bad):
    x, two = double_word(jnp.full((), bad, dtype)), double_word(jnp.full((), 2, dtype))
    for operation in (dw.add, dw.multiply, dw.divide):
        assert not np.isfinite(sum(operation(x, two)))
    assert not np.isfinite(sum(dw.divide(two, double_word(jnp.zeros((), dtype)))))
