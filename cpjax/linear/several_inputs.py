"""Pole placement for several inputs, where the poles leave freedom in the gain.

With the closed loop's eigenvectors X and directions G = K X, (A - B K) X = X diag(poles) becomes

    A X - X diag(poles) = B G,    K = G X^-1

so that directions G determine the gain, differentiably. SciPy chooses the gain whose eigenvectors are the least
sensitive (Tits and Yang, 1996); that choice is a search on the host and has no derivative.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float, Num, Real

from cpjax.errors import InputError
from cpjax.linear.arguments import MatrixLike, columns, matrices, shaped, square
from cpjax.pytree import is_traced


def robust_gain(
    A: Real[MatrixLike, "n n"], B: Real[MatrixLike, "n m"], poles: Num[ArrayLike, " n"] | Sequence[complex]
) -> Float[Array, "m n"]:
    """Returns SciPy's gain of u = -K s that gives A - B K these eigenvalues, by `scipy.signal.place_poles`.

    Args:
      A: state matrix.
      B: input matrix.
      poles: real or in complex conjugate pairs, none more often than B has independent columns.

    Raises:
      InputError: shapes that do not fit, a pole repeated too often, a pair (A, B) that is not controllable, or
        arguments that JAX is tracing.
    """
    from scipy.signal import place_poles  # not above: importing it takes a third of a second

    A, B = matrices(A=A, B=B)
    B = columns("B", B, square("A", A))
    if any(is_traced(leaf) for leaf in jax.tree.leaves((A, B, poles))):
        allowed = "known numbers, or else directions: the search for the most robust gain has no derivative"
        raise InputError("directions", None, allowed)
    wide = [np.asarray(matrix, dtype=np.float64) for matrix in (A, B)]
    shaped("poles", jnp.asarray(poles), (len(A),))
    wanted = np.asarray(poles)
    if np.max(np.sum(wanted[:, None] == wanted, axis=0)) > np.linalg.matrix_rank(wide[1]):
        raise InputError("poles", poles, "each at most as often as B has independent columns")
    try:
        with warnings.catch_warnings():
            # The poles are right all the same; they could be less sensitive.
            warnings.filterwarnings("ignore", "Convergence was not reached")
            K = place_poles(*wide, wanted).gain_matrix
    except (ValueError, np.linalg.LinAlgError) as problem:
        raise InputError("B", B, "of independent columns, and controllable with A") from problem
    found = np.linalg.eigvals(wide[0] - wide[1] @ K)
    distances = np.min(np.abs(found[:, None] - wanted), axis=0)
    if not np.all(distances <= 1e-3 * np.max(np.abs(wanted)) + 1e-12):
        raise InputError("B", B, "controllable with A, by a margin that rounding leaves visible")
    return jnp.asarray(K, A.dtype)


def pole_directions(
    A: Real[MatrixLike, "n n"], B: Real[MatrixLike, "n m"], poles: Num[ArrayLike, " n"] | Sequence[complex]
) -> Complex[Array, "m n"]:
    """Returns the directions K X of SciPy's gain K, X being its closed loop's eigenvectors in the order of the poles.

    With them `cpjax.place` gives the same gain at these A, B and poles, and one that is differentiable around them.

    Raises:
      InputError: as for `robust_gain`.
    """
    K = np.asarray(robust_gain(A, B, poles))
    A, B = matrices(A=A, B=B)
    found, X = np.linalg.eig(np.asarray(A) - np.asarray(B) @ K)
    left = list(range(len(found)))
    order = [left.pop(int(np.argmin(np.abs(found[left] - pole)))) for pole in np.asarray(poles)]
    return jnp.asarray((K @ X)[:, order], dtype=np.result_type(A.dtype, np.complex64))


def gain_by_directions(
    A: Float[Array, "n n"], B: Float[Array, "n m"], poles: Num[Any, " n"], directions: Num[Any, "m n"]
) -> Float[Array, "m n"]:
    """Returns the gain K whose closed loop's eigenvectors X satisfy K X = `directions`; differentiable.

    Args:
      A: state matrix, none of whose eigenvalues is among the poles.
      B: input matrix.
      poles: real or in complex conjugate pairs.
      directions: complex conjugate where the poles are.
    """
    shaped("directions", jnp.asarray(directions), (B.shape[1], len(A)))
    kind = np.result_type(A.dtype, np.complex64)
    G, wanted = jnp.asarray(directions).astype(kind), jnp.asarray(poles).astype(kind)
    a, identity = A.astype(kind), jnp.eye(len(A), dtype=kind)
    X = jnp.linalg.solve(a - wanted[:, None, None] * identity, (B.astype(kind) @ G).T[..., None])[..., 0].T
    return jnp.linalg.solve(X.T, G.T).T.real
