"""The linear quadratic regulator, in continuous and discrete time."""

from typing import NamedTuple

from jaxtyping import Array, Float, Real

from cpjax.linear.arguments import MatrixLike
from cpjax.linear.riccati import solve_care, solve_dare
from cpjax.pytree import Scalar


class LinearQuadratic(NamedTuple):
    """Gain of u = -K s, and Riccati solution: s' P s is the least cost of bringing s to rest."""

    K: Float[Array, "m n"]
    P: Float[Array, "n n"]


def lqr(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"],
    Q: Real[MatrixLike, "n n"],
    R: Real[MatrixLike, "m m"] | Scalar,
    N: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"] | None = None,
) -> LinearQuadratic:
    """Returns the gain that stabilises s' = A s + B u and minimises the integral of s' Q s + 2 s' N u + u' R u.

    (A, B) must be stabilisable, and every mode of A on the imaginary axis observable through Q. A mode elsewhere needs
    no weight: without one, a stable mode keeps its eigenvalue, and an unstable one is mirrored at the axis.

    K depends on the ratio of the weights alone: (c Q, c R, c N) gives the same K for any c > 0, and c P.

    Args:
      A: state matrix.
      B: input matrix; a vector for one input.
      Q: symmetric, positive semidefinite.
      R: symmetric, positive definite; a number for one input.
      N: zero if left out; a vector for one input.

    Returns:
      Gain and Riccati solution.

    Raises:
      InputError: see `cpjax.linear.riccati.solve_care`. Under jit K and P are NaN instead.
    """
    P, K, _ = solve_care(A, B, Q, R, N)
    return LinearQuadratic(K, P)


def dlqr(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"],
    Q: Real[MatrixLike, "n n"],
    R: Real[MatrixLike, "m m"] | Scalar,
    N: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"] | None = None,
) -> LinearQuadratic:
    """Returns the gain that stabilises s[k+1] = A s[k] + B u[k] and minimises the sum of s' Q s + 2 s' N u + u' R u.

    Takes and raises what `lqr` does, with the unit circle in place of the imaginary axis.
    """
    P, K, _ = solve_dare(A, B, Q, R, N)
    return LinearQuadratic(K, P)
