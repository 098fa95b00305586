"""Arithmetic with twice the working precision: a number as the unevaluated sum of two floats (Dekker, 1971).

It is used for residuals: the difference of two large, nearly equal numbers keeps digits in this arithmetic where plain
floats have none. The error bounds are those of Joldes, Muller and Popescu (2017): a few units of eps^2, relative to
the terms that were added, not to a sum in which they cancel.

Compilers may contract a product and a sum into one fused operation, which breaks the usual error-free product. Here
operands are split so that the products are exact, and contraction changes nothing.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


class DoubleWord(NamedTuple):
    """The number high + low, |low| at most half a unit in the last place of high."""

    high: Float[Array, "*shape"]
    low: Float[Array, "*shape"]


def double_word(x: Float[Array, "..."]) -> DoubleWord:
    """Converts a plain float array to double-word numbers."""
    return DoubleWord(x, jnp.zeros_like(x))


def two_sum(a: Float[Array, "*#shape"], b: Float[Array, "*#shape"]) -> DoubleWord:
    """Computes a + b exactly (Knuth).

    The barrier is needed where one of the two is a constant of the program: XLA would simplify (a + b) - a to b.
    """
    total = lax.optimization_barrier(a + b)  # type: ignore[no-untyped-call]  # JAX has no annotations for it
    part = total - a
    return DoubleWord(total, (a - (total - part)) + (b - part))


def _fast_two_sum(a: jax.Array, b: jax.Array) -> DoubleWord:
    """Computes a + b exactly, where |a| is at least |b|; for the barrier see `two_sum`."""
    total = lax.optimization_barrier(a + b)  # type: ignore[no-untyped-call]  # untyped in JAX
    return DoubleWord(total, b - (total - a))


def _split(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Splits x into two floats with half the digits each, so that products of such halves are exact."""
    kind, mask = (jnp.uint64, 0xFFFFFFFFF8000000) if x.dtype == jnp.float64 else (jnp.uint32, 0xFFFFF000)
    bits = lax.bitcast_convert_type(x, kind) & jnp.asarray(mask, dtype=kind)
    high = lax.bitcast_convert_type(bits, x.dtype)
    return high, x - high


def two_product(a: Float[Array, "*#shape"], b: Float[Array, "*#shape"]) -> DoubleWord:
    """Computes a b to twice the working precision."""
    a_high, a_low = _split(a)
    b_high, b_low = _split(b)
    cross = two_sum(a_high * b_low, a_low * b_high)
    total = two_sum(a_high * b_high, cross.high)
    return DoubleWord(total.high, total.low + (cross.low + a_low * b_low))


def add(x: DoubleWord, y: DoubleWord) -> DoubleWord:
    """Returns x + y."""
    total = two_sum(x.high, y.high)
    return _fast_two_sum(total.high, total.low + (x.low + y.low))


def negative(x: DoubleWord) -> DoubleWord:
    """Returns -x."""
    return DoubleWord(-x.high, -x.low)


def multiply(x: DoubleWord, y: DoubleWord) -> DoubleWord:
    """Returns x y."""
    total = two_product(x.high, y.high)
    return _fast_two_sum(total.high, total.low + (x.high * y.low + x.low * y.high))


def divide(x: DoubleWord, y: DoubleWord) -> DoubleWord:
    """Computes x / y by two steps of long division."""
    first = x.high / y.high
    rest = add(x, negative(multiply(double_word(first), y)))
    second = rest.high / y.high
    rest = add(rest, negative(multiply(double_word(second), y)))
    return add(_fast_two_sum(first, second), double_word(rest.high / y.high))
