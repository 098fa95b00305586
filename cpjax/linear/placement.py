"""Pole placement, and a parametrisation of stable polynomials that is smooth everywhere.

For several inputs see `several_inputs.py`. For one input the gain is Ackermann's (1972): K = e_n' C^-1 p(A), with C the
controllability matrix and p the desired characteristic polynomial. The formula is known for losing digits; here it is
evaluated in double-word arithmetic and loses none. It takes a polynomial, not poles, so that repeated poles need no
special treatment.

The derivative follows from that of the polynomial. With A_K = A - B K and adj(s I - A_K) = sum of s^(n-1-k) H_k,

    dc_k = dK H_k B - tr(H_k (dA - dB K)),    k = 0 .. n-1

is a linear equation for dK, smooth through repeated poles as well. Its solution is stored as two tables of
sensitivities, which are again sums in which digits cancel and are computed in double-word arithmetic.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float, Inexact, Num, Real

from cpjax.errors import InputError
from cpjax.linear.arguments import MatrixLike, column, columns, matrices, shaped, square
from cpjax.linear.several_inputs import gain_by_directions, robust_gain
from cpjax.numeric import double_word as dw
from cpjax.numeric.double_word import DoubleWord, double_word
from cpjax.numeric.selection import where
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
from cpjax.pytree import is_traced


def place(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"],
    poles: Num[ArrayLike, " n"] | Sequence[complex],
    directions: Num[ArrayLike, "m n"] | None = None,
) -> Float[Array, "m n"]:
    """Returns the gain K of u = -K s that gives A - B K these eigenvalues.

    For one input see `place_polynomial`. For several inputs there are many such gains. Without `directions` it is that
    of `scipy.signal.place_poles`, whose eigenvalues are the least sensitive, outside jit and without a derivative; with
    them it is differentiable, for poles that are no eigenvalues of A. The gain of an observer is that of the transposed
    problem, place(A', C', poles)'.

    Args:
      A: state matrix [1/s].
      B: input matrix.
      poles: real or in complex conjugate pairs, in any order, repeated or not; for several inputs at most as often as B
        has independent columns [1/s].
      directions: K times the eigenvector of each pole, such as `cpjax.linear.pole_directions`; for several inputs only.

    Raises:
      InputError: shapes that do not fit, concrete poles that are not closed under conjugation, or a concrete pair
        (A, B) that is not controllable. Under jit the gain is NaN instead.
    """
    A, B = matrices(A=A, B=B)
    coefficients = polynomial_from_poles(poles)
    shaped("poles", coefficients, (square("A", A),))
    if B.ndim == 2 and B.shape[1] > 1:
        B = columns("B", B, len(A))
        return robust_gain(A, B, poles) if directions is None else gain_by_directions(A, B, poles, directions)
    if directions is not None:
        raise InputError("directions", directions, "left out for one input, whose gain follows from the poles")
    return place_polynomial(A, B, coefficients.astype(A.dtype))


def place_polynomial(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n 1"] | Real[MatrixLike, " n"],
    coefficients: Real[MatrixLike, " n"],
) -> Float[Array, "1 n"]:
    """Returns the gain K of u = -K s that gives A - B K this characteristic polynomial.

    Differentiable to any order in all arguments.

    Args:
      A: state matrix [1/s].
      B: input matrix of one input.
      coefficients: of s^(n-1) down to s^0; that of s^n is 1.

    Raises:
      InputError: shapes that do not fit, or a concrete pair (A, B) that is not controllable. Under jit the gain is NaN
        instead.
    """
    A, B, coefficients = matrices(A=A, B=B, coefficients=coefficients)
    n = square("A", A)
    shaped("coefficients", coefficients, (n,))
    K, _, _ = _placement(A, column("B", B, n), coefficients)
    if not is_traced(K) and not np.all(np.isfinite(K)):
        raise InputError("B", B, "controllable with A, by a margin that rounding leaves visible")
    return K


def polynomial_from_poles(poles: Num[ArrayLike, " n"] | Sequence[complex]) -> Float[Array, " n"]:
    """Returns the coefficients, from s^(n-1) down to s^0, of the monic polynomial with these roots.

    Raises:
      InputError: not a sequence of finite numbers, or concrete ones that are not closed under conjugation. Under jit
        the coefficients are NaN instead.
    """
    if not hasattr(poles, "dtype") and not any(is_traced(p) for p in jax.tree.leaves(poles)):
        try:
            numbers = np.asarray(poles)
            if numbers.dtype.kind not in "fiuc":
                raise ValueError(f"dtype {numbers.dtype}")
        except ValueError as problem:
            raise InputError("poles", poles, "a sequence of numbers") from problem
        poles = numbers.astype(np.complex128)
    if not jnp.issubdtype(getattr(poles, "dtype", complex), jnp.number):
        raise InputError("poles", poles, "numbers")
    poles = jnp.asarray(poles)
    kind = jax.dtypes.canonicalize_dtype(poles.dtype)
    poles = poles.astype(kind if jnp.issubdtype(kind, jnp.inexact) else jnp.result_type(float))
    if poles.ndim != 1 or poles.shape[0] == 0:
        raise InputError("poles", f"array of shape {poles.shape}", "of shape (n,); batches go through jax.vmap")
    whole, bound = _expanded(poles)
    if jnp.iscomplexobj(whole):
        paired = jnp.all(jnp.abs(whole.imag) <= 1e-6 * bound)
        if not is_traced(paired) and not paired:
            raise InputError("poles", poles, "finite, and closed under conjugation: complex ones in pairs")
        whole = where(paired, whole.real, jnp.nan)
    if not is_traced(whole) and not np.all(np.isfinite(whole)):
        raise InputError("poles", poles, "finite numbers")
    return whole[1:]


@functools.partial(jax.jit, inline=True)  # one program in place of a compilation for each operation
def _expanded(poles: Inexact[Array, " n"]) -> tuple[Inexact[Array, " m"], Float[Array, " m"]]:
    """Returns the monic polynomial with these roots, and that with the negatives of their magnitudes as roots."""
    whole = jnp.ones((1,), dtype=poles.dtype)
    bound = jnp.ones((1,), dtype=poles.real.dtype)
    for i in range(poles.shape[0]):
        whole = jnp.append(whole, 0.0) - poles[i] * jnp.append(jnp.zeros((1,), dtype=whole.dtype), whole)
        bound = jnp.append(bound, 0.0) + jnp.abs(poles[i]) * jnp.append(jnp.zeros((1,), dtype=bound.dtype), bound)
    return whole, bound


class QuadraticFactors(NamedTuple):
    """A stable real polynomial as a product of factors s^2 + a s + b with a, b > 0; and s + c, if its degree is odd.

    Stable if and only if all numbers are positive. They vary smoothly where two real poles meet and become a complex
    pair and the poles themselves have no derivative: use them, or their logarithms, as parameters of a design.
    """

    a: Float[Array, " pairs"]
    """2 zeta omega, twice the mean rate of decay [1/s]."""
    b: Float[Array, " pairs"]
    """omega^2 [1/s^2]."""
    c: Float[Array, " single"]
    """None or one: the rate of decay of the single real pole [1/s]."""

    @classmethod
    def from_poles(cls, poles: Num[ArrayLike, " n"] | Sequence[complex]) -> "QuadraticFactors":
        """Computes the factors of poles [1/s]: conjugate pairs, then neighbours among the real ones, slowest first.

        Raises:
          InputError: poles that JAX is tracing, that are not closed under conjugation, or that are not all in the open
            left half plane.
        """
        if any(is_traced(p) for p in jax.tree.leaves(poles)):
            raise InputError("poles", poles, "known numbers, outside jit and vmap")
        with jax.ensure_compile_time_eval():  # also inside a function that is traced
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
        with jax.ensure_compile_time_eval():
            return cls(jnp.asarray(a), jnp.asarray(b), jnp.asarray(real[len(real) // 2 * 2 :]))

    @classmethod
    def from_unconstrained(cls, x: Float[Array, " n"]) -> "QuadraticFactors":
        """Maps any real vector to factors, one to one: the numbers are the exponentials of its elements."""
        pairs = x.shape[0] // 2
        y = positive(x)
        return cls(y[:pairs], y[pairs : 2 * pairs], y[2 * pairs :])

    def unconstrained(self) -> Float[Array, " n"]:
        """Returns the vector that `from_unconstrained` maps to these factors."""
        return from_positive(jnp.concatenate([self.a, self.b, self.c]))

    def polynomial(self) -> Float[Array, " n"]:
        """Returns the coefficients that `place_polynomial` takes."""
        whole = jnp.ones((1,), dtype=self.a.dtype)
        for i in range(self.a.shape[0]):
            whole = jnp.convolve(whole, jnp.stack([jnp.ones_like(self.a[i]), self.a[i], self.b[i]]))
        for i in range(self.c.shape[0]):
            whole = jnp.convolve(whole, jnp.stack([jnp.ones_like(self.c[i]), self.c[i]]))
        return whole[1:]

    def poles(self) -> Complex[Array, " n"]:
        """Returns the roots [1/s], for display: they have no derivative where two of them meet."""
        root = jnp.sqrt(lax.complex(self.a * self.a / 4 - self.b, jnp.zeros_like(self.a)))
        # The larger root: in the formula for the other one, the digits of a slow pole would cancel.
        first = -root - (0.5 * self.a).astype(root.dtype)
        second = where(root.imag > 0.0, first.conj(), self.b.astype(root.dtype) / first)
        return jnp.concatenate([second, first, -self.c.astype(root.dtype)])


class _Placement(NamedTuple):
    """Gain, and its sensitivities to the coefficients and to the closed loop's matrix."""

    K: Matrix
    """Shape (1, n)."""
    by_coefficient: Matrix
    """dK_j / dc_k, shape (n, n), indexed [k, j]."""
    by_element: Matrix
    """dK_j / d(A - B K)_ab at constant K, shape (n, n, n), indexed [j, a, b]."""


@batch_last
@jax.jit
def _ackermann(A: Matrix, B: Matrix, coefficients: jax.Array) -> _Placement:
    n = A.shape[0]
    a, b = double_word(A), double_word(B)
    krylov = [b]
    for _ in range(n - 1):
        krylov.append(accurate_product(a, krylov[-1]))
    identity = double_word(identity_like(A))
    last = DoubleWord(*(x[:, n - 1 :] for x in identity))
    w = transpose(accurate_solve(transpose(_side_by_side(krylov)), last))
    K = w
    for k in range(n):
        K = dw.add(accurate_product(K, a), dw.multiply(w, double_word(coefficients[None, k : k + 1])))

    closed = dw.add(a, dw.negative(accurate_product(b, K)))
    adjugates = [identity]
    for k in range(n - 1):
        constant = dw.multiply(identity, double_word(coefficients[None, k : k + 1]))
        adjugates.append(dw.add(accurate_product(closed, adjugates[-1]), constant))
    by_coefficient = accurate_solve(_side_by_side([accurate_product(H, b) for H in adjugates]), identity)
    flat = DoubleWord(
        *(
            jnp.stack([x.reshape((n * n, *x.shape[2:])) for x in part])
            for part in zip(*map(transpose, adjugates), strict=True)
        )
    )
    by_element = accurate_product(transpose(by_coefficient), flat).high.reshape((n, n, n, *A.shape[2:]))

    # No result where the pair is controllable only by rounding of the data: rounding would then determine the gain.
    gain = K.high[0]
    size = jnp.abs(A) + jnp.abs(B * gain[None])
    blur = np.finfo(A.dtype).eps * jnp.sum(jnp.abs(by_element) * size[None], axis=(1, 2))
    found = jnp.all(blur <= 0.01 * jnp.max(jnp.abs(gain), axis=0), axis=0)
    parts = K.high, by_coefficient.high, by_element
    return _Placement(*(where(found, part, jnp.nan) for part in parts))


def _side_by_side(columns: list[DoubleWord]) -> DoubleWord:
    return DoubleWord(*(jnp.concatenate(part, axis=1) for part in zip(*columns, strict=True)))


def _sensitivities(A: jax.Array, B: jax.Array, K: jax.Array, coefficients: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes the two tables of `_Placement` in plain floats, for their derivatives."""
    n = A.shape[0]
    closed, identity = A - B @ K, jnp.eye(n, dtype=A.dtype)
    adjugates = [identity]
    for k in range(n - 1):
        adjugates.append(closed @ adjugates[-1] + coefficients[k] * identity)
    by_coefficient = linear_solve(jnp.concatenate([H @ B for H in adjugates], axis=1), identity)
    return by_coefficient, jnp.einsum("kj,kba->jab", by_coefficient, jnp.stack(adjugates))


@jax.custom_jvp
def _placement(A: jax.Array, B: jax.Array, coefficients: jax.Array) -> _Placement:
    return _ackermann(A, B, coefficients)


@_placement.defjvp
def _placement_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[_Placement, _Placement]:
    A, B, c = primals
    dA, dB, dc = tangents
    found = _placement(A, B, c)
    K, by_coefficient, by_element = found
    change = dA - dB @ K
    dK = (dc @ by_coefficient + jnp.sum(by_element * change, axis=(1, 2)))[None]
    _, tables = jax.jvp(_sensitivities, (A, B, K, c), (dA, dB, dK, dc))
    return found, _Placement(dK, *tables)
