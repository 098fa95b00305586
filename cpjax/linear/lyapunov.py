"""Differentiable solvers of Lyapunov's equation and its discrete-time counterpart, Stein's, also for batches.

    A' X + X A + Q = 0            A' X A - X + Q = 0

Both are solved by doubling (Smith, 1968): the sum of A'^k Q A^k over k, with twice as many terms after each step. It
converges if and only if A is stable, so the iteration is also the stability test. A correction with the residual in
double-word arithmetic makes the result the rounded exact solution where the equation's conditioning allows it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Real

from cpjax.errors import InputError
from cpjax.linear.arguments import MatrixLike, matrices, shaped, square
from cpjax.numeric import double_word as dw
from cpjax.numeric.double_word import double_word
from cpjax.numeric.selection import where
from cpjax.numeric.small_matrices import (
    Matrix,
    accurate_product,
    batch_last,
    identity_like,
    inverse,
    largest,
    log_abs_determinant,
    product,
    transpose,
)
from cpjax.pytree import is_traced

_MOST_DOUBLINGS = 60
_SMALL = 1e-12  # size of the doubled A at convergence: the missing terms are of the order of its square


class Sum(NamedTuple):
    """Solution X, and whether A is stable; if not, X is undefined."""

    X: Float[Array, "n n *batch"]
    stable: Bool[Array, "*batch"]


def lyapunov(A: Real[MatrixLike, "n n"], Q: Real[MatrixLike, "n n"]) -> Float[Array, "n n"]:
    """Returns X of A' X + X A + Q = 0 for a stable A, all of whose eigenvalues have negative real parts.

    Differentiable to any order. Under jit, an unstable A gives NaN.

    Args:
      A: stable.
      Q: symmetric or not.

    Raises:
      InputError: shapes that do not fit, or a concrete A that is not stable.
    """
    return _solved(A, Q, lyapunov_equation, "of a stable system: every eigenvalue with a negative real part")


def stein(A: Real[MatrixLike, "n n"], Q: Real[MatrixLike, "n n"]) -> Float[Array, "n n"]:
    """Returns X of A' X A - X + Q = 0 for a stable A, all of whose eigenvalues are inside the unit circle.

    Differentiable to any order. Under jit, an unstable A gives NaN.

    Args:
      A: stable.
      Q: symmetric or not.

    Raises:
      InputError: shapes that do not fit, or a concrete A that is not stable.
    """
    return _solved(A, Q, stein_equation, "of a stable system: every eigenvalue inside the unit circle")


def _solved(A: MatrixLike, Q: MatrixLike, equation: Callable[..., jax.Array], allowed: str) -> jax.Array:
    A, Q = matrices(A=A, Q=Q)
    shaped("Q", Q, (square("A", A),) * 2)
    X = equation(A, Q)
    if not is_traced(X) and np.any(np.isnan(X)):
        raise InputError("A", A, allowed)
    return X


def lyapunov_equation(A: Float[Array, "n n"], Q: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Solves the equation of `lyapunov` without its checks."""
    return lax.custom_linear_solve(
        lambda X: -(A.T @ X + X @ A),
        Q,
        lambda _, Q: _lyapunov(A, Q),
        transpose_solve=lambda _, Q: _lyapunov(A.T, Q),
    )


def stein_equation(A: Float[Array, "n n"], Q: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Solves the equation of `stein` without its checks."""
    return lax.custom_linear_solve(
        lambda X: X - A.T @ X @ A,
        Q,
        lambda _, Q: _stein(A, Q),
        transpose_solve=lambda _, Q: _stein(A.T, Q),
    )


def sum_continuous(A: Float[Array, "n n *batch"], Q: Float[Array, "n n *batch"]) -> Sum:
    """Solves Lyapunov's equation, matrix axes first, as Stein's equation after Cayley's transform."""
    shift = cayley_shift(A)
    resolvent = inverse(shift * identity_like(A) - A)
    discrete = 2.0 * shift * resolvent - identity_like(A)
    return sum_discrete(discrete, 2.0 * shift * product(transpose(resolvent), Q, resolvent))


def sum_discrete(A: Float[Array, "n n *batch"], Q: Float[Array, "n n *batch"]) -> Sum:
    """Solves Stein's equation, matrix axes first, by doubling."""

    def unfinished(carry: tuple[Matrix, Matrix, jax.Array]) -> jax.Array:
        _, power, count = carry
        size = largest(power)
        return jnp.any((size > _SMALL) & jnp.isfinite(size)) & (count < _MOST_DOUBLINGS)

    def double(carry: tuple[Matrix, Matrix, jax.Array]) -> tuple[Matrix, Matrix, jax.Array]:
        X, power, count = carry
        return X + product(transpose(power), X, power), product(power, power), count + 1

    X, power, _ = lax.while_loop(unfinished, double, (Q, A, jnp.zeros((), dtype=jnp.int32)))
    return Sum(X, largest(power) <= _SMALL)


def cayley_shift(A: Float[Array, "n n *batch"]) -> Float[Array, "*batch"]:
    """Returns the geometric mean of |eigenvalues|, near which a shift makes doubling converge fastest."""
    return jnp.exp(log_abs_determinant(A) / A.shape[0])


@batch_last
@jax.jit
def _lyapunov(A: Matrix, Q: Matrix) -> Matrix:
    X, stable = sum_continuous(A, Q)
    a, x = double_word(A), double_word(X)
    rest = dw.add(accurate_product(transpose(a), x), accurate_product(x, a))
    more, _ = sum_continuous(A, dw.add(double_word(Q), rest).high)
    return where(stable, X + more, jnp.nan)


@batch_last
@jax.jit
def _stein(A: Matrix, Q: Matrix) -> Matrix:
    X, stable = sum_discrete(A, Q)
    a, x = double_word(A), double_word(X)
    rest = dw.add(accurate_product(transpose(a), accurate_product(x, a)), dw.negative(x))
    more, _ = sum_discrete(A, dw.add(double_word(Q), rest).high)
    return where(stable, X + more, jnp.nan)
