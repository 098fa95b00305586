"""Zero-order-hold discretisation of a linear model and of a quadratic cost.

With u held, (s, u)' = F (s, u), and the cost over a time t is a quadratic form W(t) in s and u at its beginning:

    F = [A B]    C = [Q 0]    E(t) = exp(F t) = [Ad Bd]    W(t) = integral of E' C E from 0 to t
        [0 0]        [0 0]                      [ 0  I]

    exp([-F' C] t) = [E(-t)' G(t)]    W = E' G     (Van Loan, 1978)
        [  0 F]      [  0    E(t)]

The exponential is computed for the period halved until |F t| is below 1; E(2 t) = E(t)^2 and
W(2 t) = W(t) + E(t)' W(t) E(t) then lead back to the period. So E(-t), which is huge for a stable model and a long t,
never appears, and no digits cancel in W. JAX's own scaling is not used: it stops at up to twice the norm for which its
Pade approximant is accurate, where a rotation in float64 is wrong by 2e-8, and gives NaN beyond 16 squarings.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import expm
from jaxtyping import Array, Float, Real

from cpjax.errors import InputError
from cpjax.linear.arguments import MatrixLike, columns, input_weight, matrices, shaped, square
from cpjax.numeric.selection import where
from cpjax.numeric.small_matrices import product, symmetric, transpose
from cpjax.pytree import Scalar, is_traced

_MOST_HALVINGS = 32

T = TypeVar("T")


class SampledModel(NamedTuple):
    """Discrete-time model s[k + 1] = A s[k] + B u[k], with u held in between."""

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]


class SampledCost(NamedTuple):
    """Cost of one period, s[k]' Q s[k] + 2 s[k]' N u[k] + u[k]' R u[k], in state and input at its beginning."""

    Q: Float[Array, "n n"]
    """Symmetric."""
    R: Float[Array, "m m"]
    """Symmetric."""
    N: Float[Array, "n m"]


def discretize(
    A: Real[MatrixLike, "n n"], B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"], period: Scalar
) -> SampledModel:
    """Discretises the model s' = A s + B u exactly, with the input held between control instants (zero-order hold).

    Errors are at most 8 units of rounding of a matrix's largest entry, times |A| period where that is above 1 (|A| the
    1-norm; `tests/linear/test_discretization.py`). Differentiable in all arguments, under `jit` and `vmap` too.

    Args:
      A: state matrix [1/s].
      B: input matrix; a vector for one input.
      period: above 0 [s].

    Returns:
      The discrete-time model.

    Raises:
      InputError: shapes that do not fit, numbers that are not finite and real, a period that is not above 0, or one so
        long that the model's response exceeds the dtype's range or |A| period exceeds 2^32. Where JAX traces, a bad
        number gives NaN or infinity instead.
    """
    A, B, period = _arguments(A, B, period)
    return _finite(period, _model(A, B, period))


def discretize_cost(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"],
    Q: Real[MatrixLike, "n n"],
    R: Real[MatrixLike, "m m"] | Scalar,
    period: Scalar,
) -> SampledCost:
    """Integrates s' Q s + u' R u over a period in which u is held, as a quadratic form in s and u at its beginning.

    A discrete-time regulator with this cost and the model of `discretize` minimises the continuous integral. As
    accurate and differentiable as `discretize`; only the symmetric parts of Q and R count.

    Args:
      A: state matrix [1/s].
      B: input matrix; a vector for one input.
      Q: weight of the state.
      R: weight of the input; a number for one input.
      period: above 0 [s].

    Returns:
      The weights of the discrete-time cost.

    Raises:
      InputError: as for `discretize`.
    """
    A, B, period, Q, R = _arguments(A, B, period, Q=Q, R=R)
    n, m = B.shape
    shaped("Q", Q, (n, n))
    R = input_weight("R", R, m)
    return _finite(period, _cost(A, B, Q, R, period))


@jax.jit
def _model(A: jax.Array, B: jax.Array, period: jax.Array) -> SampledModel:
    n = A.shape[0]
    F, unit = _flow(A, B, period)
    halvings = _exponent(F)
    E = _repeat(lambda E: product(E, E), expm(F / _power_of_two(halvings, F)), halvings)
    return SampledModel(E[:n, :n], unit * E[:n, n:])


@jax.jit
def _cost(A: jax.Array, B: jax.Array, Q: jax.Array, R: jax.Array, period: jax.Array) -> SampledCost:
    n, m = B.shape
    F, unit = _flow(A, B, period)
    # W is linear in Q: a large Q is scaled down to the size of F, so that it needs no halvings of its own.
    C = jnp.pad(symmetric(Q) * period, (0, m))
    weight = _power_of_two(_exponent(C), C)
    van_loan = jnp.block([[-transpose(F), C / weight], [jnp.zeros_like(F), F]])
    halvings = _exponent(van_loan)
    both = expm(van_loan / _power_of_two(halvings, F))
    E, G = both[n + m :, n + m :], both[: n + m, n + m :]

    def double(EW: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        E, W = EW
        return product(E, E), W + product(transpose(E), product(W, E))

    _, W = _repeat(double, (E, product(transpose(E), G)), halvings)
    W = weight * symmetric(W)
    # R contributes R period to the integral, independent of the model.
    return SampledCost(W[:n, :n], symmetric(R) * period + unit * W[n:, n:] * unit, unit * W[:n, n:])


def _flow(A: jax.Array, B: jax.Array, period: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns F times the period, and the unit of the input in which B is below 1."""
    m = B.shape[1]
    period = where(period > 0, period, jnp.nan)
    unit = _power_of_two(_exponent(B * period), B)
    return jnp.pad(jnp.concatenate([A * period, B * period / unit], axis=1), ((0, m), (0, 0))), unit


def _exponent(matrix: jax.Array) -> jax.Array:
    """Returns the least e >= 0 with |matrix| < 2^e in the 1-norm; no derivative, because it only chooses units."""
    norm = jnp.max(jnp.sum(jnp.abs(matrix), axis=0))
    return jnp.maximum(jnp.frexp(norm)[1], 0)


def _power_of_two(exponent: jax.Array, like: jax.Array) -> jax.Array:
    # Not jnp.ldexp(matrix, exponent): its derivative is wrong where an entry is 0.
    return jnp.ldexp(jnp.ones((), dtype=like.dtype), exponent)


def _repeat(function: Callable[[T], T], value: T, times: jax.Array) -> T:
    """Applies `function` `times` times, NaN above _MOST_HALVINGS; differentiable in reverse, unlike a `while_loop`."""

    def body(value: T, index: jax.Array) -> tuple[T, None]:
        return lax.cond(index < times, function, lambda value: value, value), None

    value = jax.tree.map(lambda x: where(times <= _MOST_HALVINGS, x, jnp.nan), value)
    return lax.scan(body, value, jnp.arange(_MOST_HALVINGS, dtype=times.dtype))[0]


def _arguments(A: Any, B: Any, period: Any, **weights: Any) -> list[jax.Array]:
    A, B, period, *others = matrices(A=A, B=B, period=period, **weights)
    n = square("A", A)
    B = columns("B", B, n)
    shaped("period", period, ())
    if not is_traced(period) and not period > 0:
        raise InputError("period", float(period), "a finite number above 0 [s]")
    return [A, B, period, *others]


def _finite(period: jax.Array, result: Any) -> Any:
    for matrix in result:
        if not is_traced(matrix) and not np.all(np.isfinite(matrix)):
            raise InputError("period", float(period), "so short that the model's response to it stays finite [s]")
    return result
