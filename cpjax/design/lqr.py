"""The linear quadratic regulator, in continuous and discrete time."""

from typing import NamedTuple

import jax

from cpjax.design.arguments import MatrixLike
from cpjax.design.riccati import solve_care, solve_dare


class LinearQuadratic(NamedTuple):
    """The gain of u = -K s, and the Riccati solution: s' P s is what it costs to come to rest from s."""

    K: jax.Array
    """Shape (m, n)."""
    P: jax.Array
    """Shape (n, n)."""


def lqr(A: MatrixLike, B: MatrixLike, Q: MatrixLike, R: MatrixLike, N: MatrixLike | None = None) -> LinearQuadratic:
    """The gain that minimises the integral of s' Q s + 2 s' N u + u' R u under s' = A s + B u.

    K depends on the ratio of the weights alone: (c Q, c R, c N) gives the same K for any c > 0, and c P.

    Args:
      A: (n, n).
      B: (n, m), or (n,) for one input.
      Q: (n, n), symmetric, positive semidefinite.
      R: (m, m), symmetric, positive definite; or a number for one input.
      N: (n, m); zero if left out.

    Raises:
      InputError: see `cpjax.design.riccati.solve_care`. Under jit K and P are NaN instead.
    """
    P, K, _ = solve_care(A, B, Q, R, N)
    return LinearQuadratic(K, P)


def dlqr(A: MatrixLike, B: MatrixLike, Q: MatrixLike, R: MatrixLike, N: MatrixLike | None = None) -> LinearQuadratic:
    """The gain that minimises the sum of s' Q s + 2 s' N u + u' R u under s[k+1] = A s[k] + B u[k]; as `lqr`."""
    P, K, _ = solve_dare(A, B, Q, R, N)
    return LinearQuadratic(K, P)
