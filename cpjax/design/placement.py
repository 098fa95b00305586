"""Pole placement for one input, and a parametrisation of stable polynomials that is smooth everywhere.

The gain is Ackermann's (1972): K = e_n' C^-1 p(A), C the controllability matrix and p the wanted characteristic
polynomial. Its formula is notorious for losing digits, and loses none here: it is evaluated in double-word arithmetic.
It asks for a polynomial, not for poles, so that repeated ones are like any others.

A derivative follows from the polynomial's own. With A_K = A - B K and adj(s I - A_K) = sum of s^(n-1-k) H_k,

    dc_k = dK H_k B - tr(H_k (dA - dB K))

is a linear equation for dK, smooth through repeated poles as well.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from cpjax.design.arguments import MatrixLike, column, matrices, shaped, square
from cpjax.errors import InputError
from cpjax.numeric import double_word as dw
from cpjax.numeric.double_word import DoubleWord, double_word
from cpjax.numeric.small_matrices import (
    Matrix,
    accurate_product,
    accurate_solve,
    batch_last,
    identity_like,
    linear_solve,
    transpose,
)
from cpjax.numeric.transforms import from_positive, positive
from cpjax.pytree import Array, is_traced


def place(A: MatrixLike, B: MatrixLike, poles: Array | Sequence[complex]) -> jax.Array:
    """The gain K (1, n) of u = -K s that gives A - B K these eigenvalues; see `place_polynomial`.

    Args:
      A: (n, n).
      B: (n, 1) or (n,).
      poles: n of them, real or in complex conjugate pairs, in any order, repeated or not [1/s].

    Raises:
      InputError: shapes that do not fit, concrete poles that are not closed under conjugation, or a concrete pair
        (A, B) that is not controllable. Under jit the gain is NaN instead.
    """
    A, B = matrices(A=A, B=B)
    coefficients = polynomial_from_poles(poles)
    shaped("poles", coefficients, (square("A", A),))
    return place_polynomial(A, B, coefficients.astype(A.dtype))


def place_polynomial(A: MatrixLike, B: MatrixLike, coefficients: Array | Sequence[float]) -> jax.Array:
    """The gain K (1, n) of u = -K s that gives A - B K this characteristic polynomial.

    Differentiable to any order in all arguments.

    Args:
      A: (n, n).
      B: (n, 1) or (n,).
      coefficients: (n,), of s^(n-1) down to s^0; that of s^n is 1.

    Raises:
      InputError: shapes that do not fit, or a concrete pair (A, B) that is not controllable. Under jit the gain is NaN
        instead.
    """
    A, B, coefficients = matrices(A=A, B=B, coefficients=coefficients)
    n = square("A", A)
    shaped("coefficients", coefficients, (n,))
    K = _gain(A, column("B", B, n), coefficients)
    if not is_traced(K) and not np.all(np.isfinite(K)):
        raise InputError("B", B, "controllable with A, by a margin that rounding leaves visible")
    return K


def polynomial_from_poles(poles: Array | Sequence[complex]) -> jax.Array:
    """The coefficients (n,) of the monic polynomial with these roots, of s^(n-1) down to s^0; that of s^n is left out.

    Raises:
      InputError: not a sequence of finite numbers, or concrete ones that are not closed under conjugation. Under jit
        the coefficients are NaN instead.
    """
    if not hasattr(poles, "dtype") and not any(is_traced(p) for p in jax.tree.leaves(poles)):
        try:
            poles = np.asarray(poles, dtype=np.complex128)
        except (TypeError, ValueError) as problem:
            raise InputError("poles", poles, "a sequence of numbers") from problem
    poles = jnp.asarray(poles)
    kind = jax.dtypes.canonicalize_dtype(poles.dtype)
    poles = poles.astype(kind if jnp.issubdtype(kind, jnp.inexact) else jnp.result_type(float))
    if poles.ndim != 1 or poles.shape[0] == 0:
        raise InputError("poles", f"array of shape {poles.shape}", "of shape (n,); batches go through jax.vmap")
    whole = jnp.ones((1,), dtype=poles.dtype)
    bound = jnp.ones((1,), dtype=poles.real.dtype)
    for i in range(poles.shape[0]):
        whole = jnp.append(whole, 0.0) - poles[i] * jnp.append(jnp.zeros((1,), dtype=whole.dtype), whole)
        bound = jnp.append(bound, 0.0) + jnp.abs(poles[i]) * jnp.append(jnp.zeros((1,), dtype=bound.dtype), bound)
    if jnp.iscomplexobj(whole):
        paired = jnp.all(jnp.abs(whole.imag) <= 1e-6 * lax.stop_gradient(bound))
        if not is_traced(paired) and not paired:
            raise InputError("poles", poles, "finite, and closed under conjugation: complex ones in pairs")
        whole = jnp.where(paired, whole.real, jnp.nan)
    if not is_traced(whole) and not np.all(np.isfinite(whole)):
        raise InputError("poles", poles, "finite numbers")
    return whole[1:]


class QuadraticFactors(NamedTuple):
    """A stable real polynomial as a product of factors s^2 + a s + b with a, b > 0; and s + c, if its degree is odd.

    Stable if and only if all numbers are positive. They move smoothly while two real poles meet and become a complex
    pair, where the poles themselves have no derivative: use these, or their logarithms, as parameters of a design.
    """

    a: jax.Array
    """Shape (n // 2,): 2 zeta omega, twice the mean rate of decay [1/s]."""
    b: jax.Array
    """Shape (n // 2,): omega^2 [1/s^2]."""
    c: jax.Array
    """Shape (n % 2,): the rate of decay of the single real pole [1/s]."""

    @classmethod
    def from_poles(cls, poles: Array | Sequence[complex]) -> "QuadraticFactors":
        """The factors of concrete poles: conjugate pairs, then neighbours among the real ones, slowest first.

        Raises:
          InputError: poles that are not closed under conjugation, or not all in the open left half plane.
        """
        if any(is_traced(p) for p in jax.tree.leaves(poles)):
            raise InputError("poles", poles, "known numbers, outside jit and vmap")
        polynomial_from_poles(poles)
        numbers = np.asarray(poles, dtype=np.complex128)
        if not np.all(numbers.real < 0.0):
            raise InputError("poles", poles, "stable: every real part below 0")
        small = 1e-9 * np.abs(numbers)
        upper = numbers[numbers.imag > small]
        real = np.sort(-numbers[np.abs(numbers.imag) <= small].real)
        if 2 * len(upper) + len(real) != len(numbers):
            raise InputError("poles", poles, "closed under conjugation: complex ones in pairs")
        first, second = real[0 : len(real) // 2 * 2 : 2], real[1::2]
        a = np.concatenate([-2.0 * upper.real, first + second])
        b = np.concatenate([np.abs(upper) ** 2, first * second])
        return cls(jnp.asarray(a), jnp.asarray(b), jnp.asarray(real[len(real) // 2 * 2 :]))

    @classmethod
    def from_unconstrained(cls, x: jax.Array) -> "QuadraticFactors":
        """The factors of any real vector (n,), one to one."""
        pairs = x.shape[0] // 2
        y = positive(x)
        return cls(y[:pairs], y[pairs : 2 * pairs], y[2 * pairs :])

    def unconstrained(self) -> jax.Array:
        """The vector (n,) of which `from_unconstrained` makes these factors."""
        return from_positive(jnp.concatenate([self.a, self.b, self.c]))

    def polynomial(self) -> jax.Array:
        """The coefficients (n,) that `place_polynomial` takes."""
        whole = jnp.ones((1,), dtype=self.a.dtype)
        for i in range(self.a.shape[0]):
            whole = jnp.convolve(whole, jnp.stack([jnp.ones_like(self.a[i]), self.a[i], self.b[i]]))
        for i in range(self.c.shape[0]):
            whole = jnp.convolve(whole, jnp.stack([jnp.ones_like(self.c[i]), self.c[i]]))
        return whole[1:]

    def poles(self) -> jax.Array:
        """The complex roots (n,), to read: they have no derivative where two of them meet [1/s]."""
        root = jnp.sqrt(lax.complex(self.a * self.a / 4 - self.b, jnp.zeros_like(self.a)))
        half = (0.5 * self.a).astype(root.dtype)
        return jnp.concatenate([root - half, -root - half, -self.c.astype(root.dtype)])


def _radius(coefficients: jax.Array) -> jax.Array:
    """A size of the polynomial's roots, by which coefficient k is measured in units of its k-th power."""
    powers = jnp.arange(1, coefficients.shape[0] + 1, dtype=coefficients.dtype)
    powers = powers.reshape(powers.shape + (1,) * (coefficients.ndim - 1))
    return jnp.max(jnp.abs(coefficients) ** (1.0 / powers), axis=0)


@batch_last
@jax.jit
def _ackermann(A: Matrix, B: Matrix, coefficients: jax.Array) -> Matrix:
    n = A.shape[0]
    a, krylov = double_word(A), [double_word(B)]
    for _ in range(n - 1):
        krylov.append(accurate_product(a, krylov[-1]))
    controllability = DoubleWord(*(jnp.concatenate(x, axis=1) for x in zip(*krylov, strict=True)))
    last = double_word(identity_like(A)[:, n - 1 :])
    w = transpose(accurate_solve(transpose(controllability), last))
    K = w
    for k in range(n):
        K = dw.add(accurate_product(K, a), dw.multiply(w, double_word(coefficients[None, k : k + 1])))
    # Rounding K must not move the poles visibly. Where the input hardly reaches a mode, K is large and what it does
    # cancels: K B, the shift of the poles' sum, is then small beside its own terms.
    terms = jnp.sum(jnp.abs(K.high[0] * B[:, 0]), axis=0)
    room = 1e-3 / np.finfo(A.dtype).eps * (_radius(coefficients) + jnp.max(jnp.abs(A), axis=(0, 1)))
    return jnp.where(terms < room, K.high, jnp.nan)


@jax.custom_jvp
def _gain(A: jax.Array, B: jax.Array, coefficients: jax.Array) -> jax.Array:
    return _ackermann(A, B, coefficients)


@_gain.defjvp
def _gain_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
    A, B, c = primals
    dA, dB, dc = tangents
    K = _gain(A, B, c)
    closed, change = A - B @ K, dA - dB @ K
    n = A.shape[0]
    identity = jnp.eye(n, dtype=A.dtype)
    scale = lax.stop_gradient(_radius(c))
    scale = 1.0 / jnp.where(scale > 0.0, scale, 1.0)
    adjugate, size, columns, right = identity, jnp.ones_like(scale), [], []
    for k in range(n):
        size = size * scale
        columns.append(size * (adjugate @ B)[:, 0])
        right.append(size * (dc[k] + jnp.sum(adjugate.T * change)))
        adjugate = closed @ adjugate + c[k] * identity
    return K, linear_solve(jnp.stack(columns), jnp.stack(right)[:, None]).T
