"""A linear model between control instants: what a held input makes of its state, and what the way there costs.

With u held, (s, u)' = F (s, u), and the cost of a time t is a quadratic form W(t) in s and u at its beginning:

    F = [A B]    C = [Q 0]    E(t) = exp(F t) = [Ad Bd]    W(t) = integral of E' C E from 0 to t
        [0 0]        [0 0]                      [ 0  I]

    exp([-F' C] t) = [E(-t)' G(t)]    W = E' G     (Van Loan, 1978)
        [  0 F]      [  0    E(t)]

The exponential is that of the period halved until F t is below 1; E(2 t) = E(t)^2, W(2 t) = W(t) + E(t)' W(t) E(t) lead
back. So E(-t), which is huge for a stable model and a long t, never appears, and no digits cancel in W. Nor is JAX's
scaling relied on: it stops at up to twice the norm that its Pade approximant is good for, where a rotation in float64
is wrong by 2e-8, and gives NaN beyond 16 squarings.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import expm

from cpjax.errors import InputError
from cpjax.linear.arguments import columns, input_weight, matrices, shaped, square
from cpjax.numeric.small_matrices import product, symmetric, transpose
from cpjax.pytree import Scalar, is_traced

_MOST_HALVINGS = 32

T = TypeVar("T")


class SampledModel(NamedTuple):
    """s[k + 1] = A s[k] + B u[k], with u held in between."""

    A: jax.Array
    """Shape (n, n)."""
    B: jax.Array
    """Shape (n, m)."""


class SampledCost(NamedTuple):
    """s[k]' Q s[k] + 2 s[k]' N u[k] + u[k]' R u[k]: the cost of one period, from what it begins with."""

    Q: jax.Array
    """Shape (n, n), symmetric."""
    R: jax.Array
    """Shape (m, m), symmetric."""
    N: jax.Array
    """Shape (n, m)."""


def discretize(A: Any, B: Any, period: Scalar) -> SampledModel:
    """The model s' = A s + B u at control instants, exactly, with the input held in between (zero-order hold).

    Errors are at most 8 units of rounding of a matrix's largest entry, times |A| period where that is above 1 (|A| the
    1-norm; `tests/linear/test_discretization.py`). Differentiable in everything, under `jit` and `vmap` too.

    Args:
      A: (n, n) [1/s].
      B: (n, m), or (n,) for one input.
      period: above 0 [s].

    Raises:
      InputError: another shape, no finite real numbers, or a period that is not above 0, or so long that the model's
        response leaves the dtype's range, or |A| period is beyond 2^32. Where JAX traces, a bad number gives NaN
        or infinity instead.
    """
    A, B, period = _arguments(A, B, period)
    return _finite(period, _model(A, B, period))


def discretize_cost(A: Any, B: Any, Q: Any, R: Any, period: Scalar) -> SampledCost:
    """The integral of s' Q s + u' R u over a period in which u is held, as a quadratic form in s and u at its start.

    A discrete-time regulator with this cost and the model of `discretize` minimises the continuous integral. As
    accurate and differentiable as `discretize`; only the symmetric parts of Q and R count.

    Args:
      A: (n, n) [1/s].
      B: (n, m), or (n,) for one input.
      Q: (n, n).
      R: (m, m), or a number for one input.
      period: above 0 [s].

    Raises:
      InputError: as `discretize`.
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
    # W is linear in Q: a large one is brought down to the size of F, so that it asks for no halvings of its own.
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
    # R's share of the integral is R period, whatever the model does.
    return SampledCost(W[:n, :n], symmetric(R) * period + unit * W[n:, n:] * unit, unit * W[:n, n:])


def _flow(A: jax.Array, B: jax.Array, period: jax.Array) -> tuple[jax.Array, jax.Array]:
    """F times the period, with the input in a unit, the second result, in which B is below 1."""
    m = B.shape[1]
    period = jnp.where(period > 0, period, jnp.nan)
    unit = _power_of_two(_exponent(B * period), B)
    return jnp.pad(jnp.concatenate([A * period, B * period / unit], axis=1), ((0, m), (0, 0))), unit


def _exponent(matrix: jax.Array) -> jax.Array:
    """The least e, at least 0, with |matrix| < 2^e in the 1-norm. Has no derivative: it is a choice of units."""
    norm = jnp.max(jnp.sum(jnp.abs(matrix), axis=0))
    return jnp.maximum(jnp.frexp(norm)[1], 0)


def _power_of_two(exponent: jax.Array, like: jax.Array) -> jax.Array:
    # Not jnp.ldexp(matrix, exponent): its derivative is wrong where an entry is 0.
    return jnp.ldexp(jnp.ones((), dtype=like.dtype), exponent)


def _repeat(function: Callable[[T], T], value: T, times: jax.Array) -> T:
    """`function` applied to `value` so many times, up to _MOST_HALVINGS; beyond, NaN. Unlike a loop, differentiable."""

    def body(value: T, index: jax.Array) -> tuple[T, None]:
        return lax.cond(index < times, function, lambda value: value, value), None

    value = jax.tree.map(lambda x: jnp.where(times <= _MOST_HALVINGS, x, jnp.nan), value)
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
