"""Solvers of the algebraic Riccati equations of the linear quadratic regulator, in continuous and discrete time.

    A' P + P A - K' R K + Q = 0                    K = R^-1 (B' P + N')
    A' P A - P - K' (R + B' P B) K + Q = 0         K = (R + B' P B)^-1 (B' P A + N')

The stabilising solution is computed, under which all eigenvalues of A - B K are stable. Of all u that bring s to rest,
u = -K s minimises the integral, or the sum, of s' Q s + 2 s' N u + u' R u.

It exists if and only if (A, B) is stabilisable and every mode of A on the boundary of stability (the imaginary axis, or
the unit circle) is observable through Q; with N, of A - B R^-1 N' through Q - N R^-1 N'. The other modes need no
weight: without one, stable modes keep their eigenvalues, and unstable ones are mirrored at the boundary.

Method: doubling, corrected by Newton's method in double-word arithmetic (`_doubling.py`), so that the result is the
rounded exact solution, unless the problem is too ill-conditioned for the dtype.

Derivatives come from the same equations (Kao and Hennequin, 2020): with dA, dB, dQ, dN, dR and D = dA - dB K,

    A_K' dP + dP A_K + (D' P + P D + dQ - dN K - K' dN' + K' dR K) = 0,      A_K = A - B K

and its counterpart, solved by a function that is itself differentiable: every order exists.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Real

from cpjax.errors import InputError
from cpjax.linear._doubling import solve_continuous, solve_discrete
from cpjax.linear.arguments import MatrixLike, columns, input_weight, matrices, shaped, square
from cpjax.linear.lyapunov import lyapunov_equation, stein_equation
from cpjax.numeric.small_matrices import linear_solve
from cpjax.pytree import Scalar, is_traced

Problem: TypeAlias = tuple[Any, Any, Any, Any, Any]
"""A (n, n), B (n, m), Q (n, n), R (m, m), N (n, m)."""


class RiccatiSolution(NamedTuple):
    """Solution P, gain K, and whether they were found; if not, both are NaN."""

    P: Float[Array, "n n"]
    K: Float[Array, "m n"]
    found: Bool[Array, ""]


def care(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"],
    Q: Real[MatrixLike, "n n"],
    R: Real[MatrixLike, "m m"] | Scalar,
    N: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"] | None = None,
) -> Float[Array, "n n"]:
    """Returns P of the continuous-time algebraic Riccati equation.

    Takes and raises what `solve_care` does.
    """
    return solve_care(A, B, Q, R, N).P


def dare(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"],
    Q: Real[MatrixLike, "n n"],
    R: Real[MatrixLike, "m m"] | Scalar,
    N: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"] | None = None,
) -> Float[Array, "n n"]:
    """Returns P of the discrete-time algebraic Riccati equation.

    Takes and raises what `solve_dare` does.
    """
    return solve_dare(A, B, Q, R, N).P


def solve_care(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"],
    Q: Real[MatrixLike, "n n"],
    R: Real[MatrixLike, "m m"] | Scalar,
    N: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"] | None = None,
) -> RiccatiSolution:
    """Solves the continuous-time Riccati equation for its stabilising solution, with its gain.

    Differentiable to any order in all arguments. Only the symmetric parts of Q and R count.

    Q may be singular, or zero: only modes of A on the imaginary axis must be observable through it (on the unit circle,
    in discrete time). An unobservable stable mode keeps its eigenvalue; an unobservable unstable one is mirrored. P is
    then singular.

    Args:
      A: state matrix.
      B: input matrix; a vector for one input.
      Q: symmetric, positive semidefinite.
      R: symmetric, positive definite; a number for one input.
      N: such that [[Q, N], [N', R]] is positive semidefinite; zero if left out; a vector for one input.

    Returns:
      P, K, and whether they were found.

    Raises:
      InputError: shapes that do not fit, a concrete Q, R or N that is not as above, a concrete pair (A, B) that is not
        stabilisable, a mode of a concrete A on the imaginary axis that is not observable through Q, or a problem too
        ill-conditioned for its dtype. Under jit P and K are NaN instead, and `found` is False.
    """
    return _solved(_continuous, "continuous", A, B, Q, R, N)


def solve_dare(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"],
    Q: Real[MatrixLike, "n n"],
    R: Real[MatrixLike, "m m"] | Scalar,
    N: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"] | None = None,
) -> RiccatiSolution:
    """Solves the discrete-time Riccati equation for its stabilising solution, with its gain; as `solve_care`.

    R must be positive definite here too: a positive definite R + B' P B is not enough.
    """
    return _solved(_discrete, "discrete", A, B, Q, R, N)


def _solved(
    equation: Callable[..., Any], time: str, A: MatrixLike, B: MatrixLike, Q: MatrixLike, R: MatrixLike, N: Any
) -> RiccatiSolution:
    given = {"A": A, "B": B, "Q": Q, "R": R} | ({} if N is None else {"N": N})
    A, B, Q, R, *cross = matrices(**given)
    n = square("A", A)
    B = columns("B", B, n)
    m = B.shape[1]
    shaped("Q", Q, (n, n))
    R = input_weight("R", R, m)
    N = columns("N", cross[0], n) if cross else jnp.zeros((n, m), dtype=A.dtype)
    shaped("N", N, (n, m))
    problem = (A, B, Q, R, N)
    concrete = not any(is_traced(x) for x in problem)
    if concrete:
        room = 16.0 * n * float(np.finfo(A.dtype).eps)
        _check_weights(time, *(np.asarray(x, dtype=np.float64) for x in (Q, R, N)), room=room)
    P, K = equation(A, B, 0.5 * (Q + Q.T), 0.5 * (R + R.T), N)
    found = jnp.all(jnp.isfinite(P))
    if concrete and not found:
        _check_modes(
            time, *(np.asarray(x, dtype=np.float64) for x in problem), room=float(np.finfo(A.dtype).eps) ** 0.5
        )
        raise InputError("A", A, f"better conditioned with B, Q and R: in {A.dtype}, rounding hides the solution")
    return RiccatiSolution(P, K, found)


# --- derivatives, of plain matrices -----------------------------------------------------------------------------------


@jax.custom_jvp
def _continuous(A: jax.Array, B: jax.Array, Q: jax.Array, R: jax.Array, N: jax.Array) -> tuple[jax.Array, jax.Array]:
    return solve_continuous(A, B, Q, R, N)


@jax.custom_jvp
def _discrete(A: jax.Array, B: jax.Array, Q: jax.Array, R: jax.Array, N: jax.Array) -> tuple[jax.Array, jax.Array]:
    return solve_discrete(A, B, Q, R, N)


def _forcing(P: jax.Array, K: jax.Array, push: jax.Array, tangents: Problem) -> jax.Array:
    """Returns the forcing term of the equation for dP; `push` is P (dA - dB K), in discrete time A_K' P (dA - dB K)."""
    _, _, dQ, dR, dN = tangents
    cross = dN @ K
    return push + push.T + dQ - cross - cross.T + K.T @ dR @ K


@_continuous.defjvp
def _continuous_jvp(primals: Problem, tangents: Problem) -> tuple[Any, Any]:
    A, B, _, R, _ = primals
    dA, dB, _, dR, dN = tangents
    P, K = _continuous(*primals)
    change = dA - dB @ K
    dP = lyapunov_equation(A - B @ K, _forcing(P, K, P @ change, tangents))
    dK = linear_solve(R, dB.T @ P + B.T @ dP + dN.T - dR @ K)
    return (P, K), (dP, dK)


@_discrete.defjvp
def _discrete_jvp(primals: Problem, tangents: Problem) -> tuple[Any, Any]:
    A, B, _, R, _ = primals
    dA, dB, _, dR, dN = tangents
    P, K = _discrete(*primals)
    closed = A - B @ K
    change = dA - dB @ K
    dP = stein_equation(closed, _forcing(P, K, closed.T @ P @ change, tangents))
    BP = B.T @ P
    dK = linear_solve(R + BP @ B, (dB.T @ P + B.T @ dP) @ closed + BP @ change + dN.T - dR @ K)
    return (P, K), (dP, dK)


# --- diagnosis of a missing solution, for error messages --------------------------------------------------------------

_Numbers: TypeAlias = np.ndarray


def _check_weights(time: str, Q: _Numbers, R: _Numbers, N: _Numbers, *, room: float) -> None:
    for name, weight in (("Q", Q), ("R", R)):
        if np.max(np.abs(weight - weight.T)) > 1e-6 * np.max(np.abs(weight)):
            raise InputError(name, weight, "a symmetric matrix")
    if not np.min(np.linalg.eigvalsh(R)) > 0.0:
        also = "" if time == "continuous" else "; that R + B' P B is positive definite is not enough"
        raise InputError("R", R, f"positive definite: every input must cost something{also}")
    joint = np.block([[Q, N], [N.T, R]]) if np.any(N) else Q
    size = np.sqrt(np.abs(np.diag(joint)))
    size[size == 0.0] = 1.0
    if not np.min(np.linalg.eigvalsh(joint / np.outer(size, size))) >= -room:
        if np.any(N):
            raise InputError("N", N, "such that [[Q, N], [N', R]] is positive semidefinite, to rounding")
        raise InputError("Q", Q, "positive semidefinite, to rounding")


def _check_modes(time: str, A: _Numbers, B: _Numbers, Q: _Numbers, R: _Numbers, N: _Numbers, *, room: float) -> None:
    """Refuses, to the tolerance `room`, an uncontrollable unstable mode and an unobservable mode on the boundary."""
    mode = _fixed_mode(A, B, _unstable_modes(time, A, room), room)
    if mode is not None:
        allowed = (
            f"stabilisable with A: it must move the mode with eigenvalue {mode:.6g}, which is not stable by itself"
        )
        raise InputError("B", B, allowed)
    weight = np.linalg.inv(R)
    free, cost = A - B @ weight @ N.T, Q - N @ weight @ N.T
    mode = _fixed_mode(free.T, cost, _modes_moved_to_boundary(time, free), room)
    if mode is not None:
        boundary = "imaginary axis" if time == "continuous" else "unit circle"
        allowed = f"detectable with A on the {boundary}: it must weigh the mode with eigenvalue {mode:.6g}"
        raise InputError("Q", Q, allowed)


def _unstable_modes(time: str, A: _Numbers, room: float) -> _Numbers:
    """Returns the eigenvalues outside or on the boundary of stability, to the tolerance `room`."""
    modes: _Numbers = np.linalg.eigvals(A)
    beyond = modes.real / max(float(np.linalg.norm(A)), 1e-300) if time == "continuous" else np.abs(modes) - 1.0
    return modes[beyond > -room]


def _modes_moved_to_boundary(time: str, A: _Numbers) -> _Numbers:
    """Returns for every eigenvalue (in discrete time, except 0) the nearest point of the boundary of stability.

    Rounding splits repeated eigenvalues by far more than it changes the matrix. So the test is not which of them are
    close to the boundary, but at which of these points the matrix is close to having one.
    """
    modes: _Numbers = np.linalg.eigvals(A).astype(np.complex128)
    if time == "continuous":
        return 1j * modes.imag
    return modes[modes != 0.0] / np.abs(modes[modes != 0.0])


def _fixed_mode(A: _Numbers, B: _Numbers, modes: _Numbers, room: float) -> complex | None:
    """Returns a given number that is an uncontrollable eigenvalue of A (Popov, Belevitch and Hautus), or None."""
    size, push = max(float(np.linalg.norm(A)), 1e-300), max(float(np.linalg.norm(B)), 1e-300)
    for mode in modes:
        pencil = np.hstack([(mode * np.eye(len(A)) - A) / size, B / push])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < room:
            # Adding 0 turns -0 into 0, which is printed without a sign.
            return complex(mode.real + 0.0, mode.imag) if abs(mode.imag) > room * size else float(mode.real) + 0.0
    return None
