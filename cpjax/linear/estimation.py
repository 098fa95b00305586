"""Steady gains of Kalman filters."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Real

from cpjax.linear.arguments import MatrixLike, columns, matrices, rows, square
from cpjax.linear.lqr import dlqr
from cpjax.pytree import Scalar


class KalmanGain(NamedTuple):
    """Steady gain of a discrete-time Kalman filter and the covariance behind it."""

    L: Float[Array, "n p"]
    """Gain of the predictor: x[k+1] = A x[k] + B u[k] + L (y[k] - C x[k])."""
    P: Float[Array, "n n"]
    """Covariance of the prediction's error, given all earlier measurements."""
    filter: Float[Array, "n p"]
    """Gain of the filter: the prediction at k becomes the estimate at k by adding filter (y[k] - C x[k])."""


def dlqe(
    A: Real[MatrixLike, "n n"],
    G: Real[MatrixLike, "n d"] | Real[MatrixLike, " n"],
    C: Real[MatrixLike, "p n"] | Real[MatrixLike, " n"],
    QN: Real[MatrixLike, "d d"] | Scalar,
    RN: Real[MatrixLike, "p p"] | Scalar,
) -> KalmanGain:
    """Computes the steady Kalman gain of x[k+1] = A x[k] + B u[k] + G w[k], y[k] = C x[k] + v[k].

    Arguments as in python-control's `dlqe`. Differentiable, under `jit` and `vmap` too.

    Args:
      A: state matrix.
      G: how the disturbance w enters; a vector for one.
      C: output matrix; a vector for one output.
      QN: covariance of w.
      RN: covariance of v, positive definite.

    Returns:
      The gains and the covariance.

    Raises:
      InputError: shapes that do not fit, covariances that are none, or a pair (A, C) that is not detectable.
    """
    A, G, C, QN, RN = matrices(A=A, G=G, C=C, QN=QN, RN=RN)
    n = square("A", A)
    G, C = columns("G", G, n), rows("C", C, n)
    QN, RN = jnp.reshape(QN, (G.shape[1],) * 2), jnp.reshape(RN, (C.shape[0],) * 2)
    K, P = dlqr(A.T, C.T, G @ QN @ G.T, RN)
    covariance = C @ P @ C.T + RN
    return KalmanGain(K.T, P, jnp.linalg.solve(covariance, C @ P).T)
