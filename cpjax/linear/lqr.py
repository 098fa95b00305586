"""The linear quadratic regulator, in continuous and discrete time."""

from typing import NamedTuple

import jax

from cpjax.linear.arguments import MatrixLike
from cpjax.linear.riccati import solve_care, solve_dare


class LinearQuadratic(NamedTuple):
    """Gain of u = -K s, and Riccati solution: s' P s is the least cost of bringing s to rest."""

    K: jax.Array
    """Shape (m, n)."""
    P: jax.Array
    """Shape (n, n)."""


def lqr(A: MatrixLike, B: MatrixLike, Q: MatrixLike, R: MatrixLike, N: MatrixLike | None = None) -> LinearQuadratic:
    """Returns the gain that stabilises s' = A s + B u and minimises the integral of s' Q s + 2 s' N u + u' R u.

    (A, B) must be stabilisable, and every mode of A on the imaginary axis observable through Q. A mode elsewhere needs
    no weight: without one, a stable mode keeps its eigenvalue, and an unstable one is mirrored at the axis.

    K depends on the ratio of the weights alone: (c Q, c R, c N) gives the same K for any c > 0, and c P.

    Args:
      A: (n, n).
      B: (n, m), or (n,) for one input.
      Q: (n, n), symmetric, positive semidefinite.
      R: (m, m), symmetric, positive definite; or a number for one input.
      N: (n, m); zero if left out.

    Raises:
      InputError: see `cpjax.linear.riccati.solve_care`. Under jit K and P are NaN instead.
    """
    P, K, _ = solve_care(A, B, Q, R, N)
    return LinearQuadratic(K, P)


def dlqr(A: MatrixLike, B: MatrixLike, Q: MatrixLike, R: MatrixLike, N: MatrixLike | None = None) -> LinearQuadratic:
    """Returns the gain that stabilises s[k+1] = A s[k] + B u[k] and minimises the sum of s' Q s + 2 s' N u + u' R u.

    Arguments and errors as for `lqr`, with the unit circle in place of the imaginary axis.
    """
    P, K, _ = solve_dare(A, B, Q, R, N)
    return LinearQuadratic(K, P)
