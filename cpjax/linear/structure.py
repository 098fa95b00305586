"""Controllability and observability of a linear model, and their Gramians."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int32, Real

from cpjax.errors import InputError
from cpjax.linear.arguments import MatrixLike, columns, matrices, rows, square
from cpjax.linear.lyapunov import lyapunov
from cpjax.numeric.selection import where
from cpjax.pytree import Number, Scalar, is_traced

POSITION_AND_ANGLE = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
"""Output matrix C of the paper's two encoders, x [m] and theta [rad], in the state order of `State`; D is zero."""

_MOST_DOUBLINGS = 60


class Structure(NamedTuple):
    """A controllability or observability matrix, and its rank and conditioning."""

    matrix: Float[Array, "rows columns"]
    """Shape (n, n m) or (n p, n)."""
    rank: Int32[Array, ""]
    """Singular values above eps times the matrix's longer side times the largest one."""
    singular_values: Float[Array, " n"]
    """Descending."""
    condition: Float[Array, ""]
    """Largest over smallest singular value; inf if that is 0. It depends on the states' units."""

    @property
    def full(self) -> Bool[Array, ""]:
        """Whether the rank is n, so that the pair is controllable or observable."""
        return self.rank == self.singular_values.shape[-1]


def controllability_matrix(
    A: Real[MatrixLike, "n n"], B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"]
) -> Float[Array, "n nm"]:
    """Computes [B, A B, ..., A^(n-1) B].

    Args:
      A: state matrix.
      B: input matrix; a vector for one input.

    Returns:
      n blocks of m columns each.

    Raises:
      InputError: not finite real matrices of these shapes.
    """
    A, B = _state_and_inputs(A, B)
    blocks = [B]
    for _ in range(A.shape[0] - 1):
        blocks.append(A @ blocks[-1])
    return jnp.concatenate(blocks, axis=1)


def observability_matrix(
    A: Real[MatrixLike, "n n"], C: Real[MatrixLike, "p n"] | Real[MatrixLike, " n"]
) -> Float[Array, "np n"]:
    """Computes [C; C A; ...; C A^(n-1)].

    Args:
      A: state matrix.
      C: output matrix; a vector for one output.

    Returns:
      n blocks of p rows each.

    Raises:
      InputError: not finite real matrices of these shapes.
    """
    A, C = _state_and_outputs(A, C)
    return controllability_matrix(A.T, C.T).T


def controllability(A: Real[MatrixLike, "n n"], B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"]) -> Structure:
    """Computes rank and conditioning of the controllability matrix.

    The rank is subject to rounding: the matrix holds powers of A, so that beyond about eight states, or with fast and
    slow modes together, a controllable pair may lack rank. A Gramian is then the more reliable test.

    Args:
      A: state matrix.
      B: input matrix; a vector for one input.

    Raises:
      InputError: not finite real matrices of these shapes.
    """
    return _structure(controllability_matrix(A, B))


def observability(A: Real[MatrixLike, "n n"], C: Real[MatrixLike, "p n"] | Real[MatrixLike, " n"]) -> Structure:
    """Computes rank and conditioning of the observability matrix; see `controllability`.

    Args:
      A: state matrix.
      C: output matrix; a vector for one output.

    Raises:
      InputError: not finite real matrices of these shapes.
    """
    return _structure(observability_matrix(A, C))


def controllability_gramian(
    A: Real[MatrixLike, "n n"], B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"], horizon: Scalar | None = None
) -> Float[Array, "n n"]:
    """Computes W, the integral from 0 to `horizon` of e^(A t) B B' e^(A' t) dt.

    x' W^-1 x is the least input energy that takes the state from rest at 0 to x within the horizon.

    A finite horizon needs no stability. Van Loan's block exponential (1978) covers a piece of it of at most
    1 / norm(A), and doubling the rest, W(2t) = W(t) + e^(A t) W(t) e^(A' t): a sum without cancellation. The relative
    error grows with the horizon as that of e^(A horizon) does, a few eps per unit of norm(A) * horizon; where
    e^(A horizon) overflows, so does W. (The block exponential alone loses digits with e^(norm(A) * horizon).)

    Args:
      A: state matrix [1/s].
      B: input matrix; a vector for one input.
      horizon: [s], at least 0; None or inf for all time, which requires a stable A. A traced one must be finite.

    Returns:
      W, symmetric. For all time it is NaN inside jit if A is not stable.

    Raises:
      InputError: not finite real matrices of these shapes; a negative horizon; an infinite one where a concrete A is
        not stable.
    """
    A, B = _state_and_inputs(A, B)
    return _gramian(A, B @ B.T, horizon)


def observability_gramian(
    A: Real[MatrixLike, "n n"], C: Real[MatrixLike, "p n"] | Real[MatrixLike, " n"], horizon: Scalar | None = None
) -> Float[Array, "n n"]:
    """Computes W, the integral from 0 to `horizon` of e^(A' t) C' C e^(A t) dt.

    x' W x is the output's energy over the horizon, from the state x without input. For accuracy see
    `controllability_gramian`.

    Args:
      A: state matrix [1/s].
      C: output matrix; a vector for one output.
      horizon: [s], at least 0; None or inf for all time, which requires a stable A. A traced one must be finite.

    Returns:
      W, symmetric. For all time it is NaN inside jit if A is not stable.

    Raises:
      InputError: not finite real matrices of these shapes; a negative horizon; an infinite one where a concrete A is
        not stable.
    """
    A, C = _state_and_outputs(A, C)
    return _gramian(A.T, C.T @ C, horizon)


def _state_and_inputs(A: Any, B: Any) -> list[jax.Array]:
    A, B = matrices(A=A, B=B)
    n = square("A", A)
    return [A, columns("B", B, n)]


def _state_and_outputs(A: Any, C: Any) -> list[jax.Array]:
    A, C = matrices(A=A, C=C)
    n = square("A", A)
    return [A, rows("C", C, n)]


def _structure(matrix: jax.Array) -> Structure:
    values = jnp.linalg.svd(matrix, compute_uv=False)
    tolerance = max(matrix.shape) * float(np.finfo(matrix.dtype).eps) * values[0]
    regular = values[-1] > 0.0
    condition = where(regular, values[0] / where(regular, values[-1], 1.0), jnp.inf)
    return Structure(matrix, jnp.sum(values > tolerance).astype(jnp.int32), values, condition)


def _gramian(A: jax.Array, Q: jax.Array, horizon: Scalar | None) -> jax.Array:
    """Computes the integral of e^(A t) Q e^(A' t) from 0 to the horizon."""
    horizon = math.inf if horizon is None else horizon
    rule = Number("s", "horizon", at_least=0.0, infinite=True)
    horizon = rule.normalise("horizon", horizon)
    if np.shape(horizon) != ():
        raise InputError("horizon", f"array of shape {np.shape(horizon)}", "one number; batches go through jax.vmap")
    if not is_traced(horizon) and np.isinf(horizon):
        try:
            return lyapunov(A.T, Q)
        except InputError as problem:
            raise InputError("horizon", horizon, "finite where A is not stable") from problem
    return _gramian_until(A, Q, jnp.asarray(horizon, dtype=A.dtype))


@jax.jit
def _gramian_until(A: jax.Array, Q: jax.Array, horizon: jax.Array) -> jax.Array:
    n = A.shape[0]
    norm = jnp.max(jnp.sum(jnp.abs(A), axis=0))
    wanted = jnp.clip(jnp.ceil(jnp.log2(norm * horizon)), 0.0, _MOST_DOUBLINGS)
    doublings = lax.stop_gradient(wanted)  # a step function of A and the horizon: its derivative is 0 or undefined
    short = horizon * jnp.exp2(-doublings)
    # W is linear in Q; in this unit Q does not make the block large.
    unit = lax.stop_gradient(jnp.max(jnp.abs(Q)) * short)  # it cancels, so it needs no derivative
    unit = where(unit > 0.0, unit, 1.0)
    block = jnp.block([[-A, Q / unit], [jnp.zeros_like(A), A.T]])
    exponential = jax.scipy.linalg.expm(block * short)
    flow = exponential[n:, n:].T

    def double(carry: tuple[jax.Array, jax.Array], i: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
        flow, W = carry
        active = i < doublings
        # Inactive steps compute with 0, so that nothing overflows in a branch that is not taken.
        e = where(active, flow, 0.0)
        return (where(active, e @ e, flow), W + e @ W @ e.T), None

    (_, W), _ = lax.scan(double, (flow, flow @ exponential[:n, n:]), jnp.arange(_MOST_DOUBLINGS, dtype=A.dtype))
    return 0.5 * unit * (W + W.T)
