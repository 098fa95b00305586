"""Solvers of the algebraic Riccati equations of the linear quadratic regulator, in continuous and discrete time.

    A' P + P A - K' R K + Q = 0                    K = R^-1 (B' P + N')
    A' P A - P - K' (R + B' P B) K + Q = 0         K = (R + B' P B)^-1 (B' P A + N')

The stabilising solution is computed, under which all eigenvalues of A - B K are stable. Of all u that bring s to rest,
u = -K s minimises the integral, or the sum, of s' Q s + 2 s' N u + u' R u.

It exists if and only if (A, B) is stabilisable and every mode of A on the boundary of stability (the imaginary axis, or
the unit circle) is observable through Q; with N, of A - B R^-1 N' through Q - N R^-1 N'. The other modes need no
weight: without one, stable modes keep their eigenvalues, and unstable ones are mirrored at the boundary.

Method: a structure-preserving doubling algorithm (Anderson, 1978; Chu, Fan and Lin, 2005) finds P to most of its
digits. Newton's method (Kleinman, 1964; Hewer, 1971) corrects it, with the residual, P and K in double-word arithmetic,
so that the result is the rounded exact solution, unless the problem is too ill-conditioned for the dtype. Each
correction solves a Lyapunov or Stein equation, which also proves the closed loop stable. Where this fails, it is
repeated with doubling in double-word arithmetic and with a weight at the end of the horizon: P and the solution of the
dual equation may be so large that doubling lost all digits, or an unstable mode may be unobservable through Q, in which
case doubling without that weight finds a solution that does not stabilise.

Derivatives come from the same equations (Kao and Hennequin, 2020): with dA, dB, dQ, dN, dR and D = dA - dB K,

    A_K' dP + dP A_K + (D' P + P D + dQ - dN K - K' dN' + K' dR K) = 0,      A_K = A - B K

and its counterpart, solved by a function that is itself differentiable: every order exists.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from cpjax.errors import InputError
from cpjax.linear.arguments import MatrixLike, columns, input_weight, matrices, shaped, square
from cpjax.linear.lyapunov import Sum, cayley_shift, lyapunov_equation, stein_equation, sum_continuous, sum_discrete
from cpjax.numeric import double_word as dw
from cpjax.numeric.double_word import DoubleWord, double_word
from cpjax.numeric.small_matrices import (
    Matrix,
    accurate_product,
    accurate_solve,
    batch_last,
    diagonal,
    identity_like,
    inverse,
    is_positive_definite,
    largest,
    linear_solve,
    product,
    solve,
    symmetric,
    transpose,
)
from cpjax.pytree import is_traced

_MOST_DOUBLINGS = 60
_MOST_CORRECTIONS = 12

Problem: TypeAlias = tuple[Any, Any, Any, Any, Any]
"""A (n, n), B (n, m), Q (n, n), R (m, m), N (n, m)."""


class RiccatiSolution(NamedTuple):
    """Solution P (n, n), gain K (m, n), and whether they were found; if not, both are NaN."""

    P: jax.Array
    K: jax.Array
    found: jax.Array


def care(A: MatrixLike, B: MatrixLike, Q: MatrixLike, R: MatrixLike, N: MatrixLike | None = None) -> jax.Array:
    """Returns P (n, n) of the continuous-time algebraic Riccati equation; see `solve_care`."""
    return solve_care(A, B, Q, R, N).P


def dare(A: MatrixLike, B: MatrixLike, Q: MatrixLike, R: MatrixLike, N: MatrixLike | None = None) -> jax.Array:
    """Returns P (n, n) of the discrete-time algebraic Riccati equation; see `solve_dare`."""
    return solve_dare(A, B, Q, R, N).P


def solve_care(
    A: MatrixLike, B: MatrixLike, Q: MatrixLike, R: MatrixLike, N: MatrixLike | None = None
) -> RiccatiSolution:
    """Solves the continuous-time Riccati equation for its stabilising solution, with its gain.

    Differentiable to any order in all arguments. Only the symmetric parts of Q and R count.

    Q may be singular, or zero: only modes of A on the imaginary axis must be observable through it (on the unit circle,
    in discrete time). An unobservable stable mode keeps its eigenvalue; an unobservable unstable one is mirrored. P is
    then singular.

    Args:
      A: (n, n).
      B: (n, m), or (n,) for one input.
      Q: (n, n), symmetric, positive semidefinite.
      R: (m, m), symmetric, positive definite; or a number for one input.
      N: (n, m), such that [[Q, N], [N', R]] is positive semidefinite; zero if left out.

    Raises:
      InputError: shapes that do not fit, a concrete Q, R or N that is not as above, a concrete pair (A, B) that is not
        stabilisable, a mode of a concrete A on the imaginary axis that is not observable through Q, or a problem too
        ill-conditioned for its dtype. Under jit P and K are NaN instead, and `found` is False.
    """
    return _solved(_continuous, "continuous", A, B, Q, R, N)


def solve_dare(
    A: MatrixLike, B: MatrixLike, Q: MatrixLike, R: MatrixLike, N: MatrixLike | None = None
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


# --- the solutions, matrix axes first ---------------------------------------------------------------------------------


@batch_last
@jax.jit
def _solve_continuous(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, N: Matrix) -> tuple[Matrix, Matrix]:
    a, b, q, r, cross = (double_word(x) for x in (A, B, Q, R, transpose(N)))

    def gain(P: DoubleWord) -> tuple[DoubleWord, DoubleWord]:
        right = dw.add(accurate_product(transpose(b), P), cross)
        return accurate_solve(r, right), right

    def correction(P: DoubleWord) -> Sum:
        K, right = gain(P)
        PA = accurate_product(P, a)
        rest = dw.add(q, dw.negative(accurate_product(transpose(right), K)))
        rest = dw.add(dw.add(PA, transpose(PA)), rest)
        return sum_continuous(A - product(B, K.high), symmetric(rest.high))

    return _found(_cayley(A, B, Q, R, N), correction, gain, _weights_are_valid(Q, R, N))


@batch_last
@jax.jit
def _solve_discrete(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, N: Matrix) -> tuple[Matrix, Matrix]:
    a, b, q, r, cross = (double_word(x) for x in (A, B, Q, R, transpose(N)))

    def gain(P: DoubleWord) -> tuple[DoubleWord, DoubleWord]:
        BP = accurate_product(transpose(b), P)
        right = dw.add(accurate_product(BP, a), cross)
        return accurate_solve(dw.add(r, accurate_product(BP, b)), right), right

    def correction(P: DoubleWord) -> Sum:
        K, right = gain(P)
        rest = dw.add(accurate_product(transpose(a), accurate_product(P, a)), dw.negative(P))
        rest = dw.add(rest, dw.add(q, dw.negative(accurate_product(transpose(right), K))))
        return sum_discrete(A - product(B, K.high), symmetric(rest.high))

    A0, G, H = _without_cross_term(A, B, Q, R, N)
    scale = _balance(G, H)
    doubled = _Doubled(A0, G * scale, H / scale, scale)
    return _found(doubled, correction, gain, _weights_are_valid(Q, R, N))


class _Doubled(NamedTuple):
    """Initial values of doubling: E, G, H of a discrete-time problem, and the scale of P."""

    E: Matrix
    G: Matrix
    H: Matrix
    scale: jax.Array


class _Start(NamedTuple):
    """Initial value of Newton's method."""

    P: Matrix
    plausible: jax.Array


class _Arithmetic(NamedTuple):
    """Operations of one precision, on plain or on double-word matrices."""

    number: Callable[[Matrix], Any]
    rounded: Callable[[Any], Matrix]
    add: Callable[[Any, Any], Any]
    product: Callable[[Any, Any], Any]
    solve: Callable[[Any, Any], Any]


_PLAIN = _Arithmetic(lambda x: x, lambda x: x, jnp.add, product, solve)
_ACCURATE = _Arithmetic(double_word, lambda x: x.high, dw.add, accurate_product, accurate_solve)


def _found(
    problem: _Doubled,
    correction: Callable[[DoubleWord], Sum],
    gain: Callable[[DoubleWord], tuple[DoubleWord, DoubleWord]],
    valid: jax.Array,
) -> tuple[Matrix, Matrix]:
    """Returns P and K, NaN where there are none. The second attempt is made only if a batch element needs it."""
    P, K = _corrected(_double(problem, _PLAIN), correction, gain, valid)
    finite = jnp.all(jnp.isfinite(problem.E + problem.G + problem.H), axis=(0, 1))
    missed = valid & finite & ~jnp.all(jnp.isfinite(P), axis=(0, 1))

    def again() -> tuple[Matrix, Matrix]:
        start = _double(problem, _ACCURATE, _terminal_weight(problem))
        more = _corrected(start, correction, gain, missed)
        return jnp.where(missed, more[0], P), jnp.where(missed, more[1], K)

    found: tuple[Matrix, Matrix] = lax.cond(jnp.any(missed), again, lambda: (P, K))
    return found


def _terminal_weight(problem: _Doubled) -> Matrix:
    """Returns S (n, n) of the cost s' S s at the end of the horizon: diagonal, above 0 where an input moves the state.

    Doubling takes the horizon to infinity. Without S it finds the least positive semidefinite solution, under which an
    unstable mode that is unobservable through Q stays unstable; with an S that weighs such modes, the stabilising one
    (Chan, Goodwin and Sin, 1984). The size of S matters little. It is taken from a Gramian of the inputs, which gives
    it the units of P for any units of the states; growing powers of E are scaled down.
    """
    E, G, _, _ = problem
    identity = identity_like(E)
    trace, trace_of_square = (jnp.sum(x * identity, axis=(0, 1)) for x in (E, product(E, E)))
    growth = jnp.maximum(jnp.maximum(trace * trace, jnp.abs(trace_of_square)), 1.0)
    total = term = G
    for _ in range(E.shape[0] - 1):
        term = product(E, term, transpose(E)) / growth
        total = total + term
    weight = 1.0 / diagonal(total)
    return identity * jnp.where((weight > 0.0) & jnp.isfinite(weight), weight, 0.0)


def _without_cross_term(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, N: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """Returns A, G = B R^-1 B' and H = Q of the equivalent equation with N = 0."""
    weight = inverse(R)
    H = symmetric(Q - product(N, weight, transpose(N)))
    return A - product(B, weight, transpose(N)), symmetric(product(B, weight, transpose(B))), H


def _balance(G: Matrix, H: Matrix) -> jax.Array:
    """Returns the factor that makes G and H equally large; P is scaled by its reciprocal."""
    scale = jnp.sqrt(largest(H) / largest(G))
    return jnp.where((scale > 0.0) & jnp.isfinite(scale), scale, 1.0)


def _cayley(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, N: Matrix) -> _Doubled:
    """Returns the discrete-time problem with the same solution, up to its scale (Chu, Fan and Lin, 2005)."""
    A, G, H = _without_cross_term(A, B, Q, R, N)
    scale = _balance(G, H)
    G, H = G * scale, H / scale
    upper = jnp.concatenate([A, -G], axis=1)
    lower = jnp.concatenate([-H, -transpose(A)], axis=1)
    shift = cayley_shift(jnp.concatenate([upper, lower], axis=0))
    identity = identity_like(A)

    def inverses(shift: jax.Array) -> tuple[Matrix, Matrix, jax.Array]:
        resolvent = shift * inverse(shift * identity - A)
        coupled = shift * inverse(shift * identity - transpose(A) + product(H, resolvent / shift, G))
        size = jnp.maximum(largest(resolvent), largest(coupled))
        return resolvent, coupled, jnp.where(jnp.isfinite(size), size, jnp.inf)

    # The shift is near the geometric mean of the closed loop's eigenvalues; the factors prevent it from being an
    # eigenvalue of A by construction. It may still be one by chance: of two shifts, the one farther away is taken.
    *one, near = inverses(1.0987 * shift)
    *other, far = inverses(1.4321 * shift)
    resolvent, coupled = (jnp.where(near <= far, x, y) for x, y in zip(one, other, strict=True))
    shift = jnp.where(near <= far, 1.0987, 1.4321) * shift
    E = 2.0 * transpose(coupled) - identity
    G = 2.0 * product(resolvent, G, coupled) / shift
    H = 2.0 * product(coupled, H, resolvent) / shift
    return _Doubled(E, symmetric(G), symmetric(H), scale)


def _double(problem: _Doubled, arithmetic: _Arithmetic, terminal: Matrix | None = None) -> _Start:
    """Doubles the horizon (Anderson) until H is the solution, G that of the dual equation, and E vanishes.

    With a cost `terminal` at the end of the horizon, the same is done to the equation of P - terminal.
    """
    number, rounded, add, times, divide = arithmetic
    eps = np.finfo(problem.E.dtype).eps
    n = problem.E.shape[0]
    identity = number(identity_like(problem.E))
    Carry: TypeAlias = tuple[Any, Any, Any, jax.Array, jax.Array, jax.Array]

    def even(x: Any) -> Any:
        half = jax.tree.map(lambda part: 0.5 * part, x)
        return add(half, transpose(half))

    def split(both: Any) -> tuple[Any, Any]:
        left, right = (jax.tree.map(lambda x, part=part: x[:, part], both) for part in (slice(n), slice(n, None)))
        return left, right

    def beside(x: Any, y: Any) -> Any:
        return jax.tree.map(lambda x, y: jnp.concatenate([x, y], axis=1), x, y)

    def solution(H: Any) -> Matrix:
        return rounded(H if terminal is None else add(H, number(terminal)))

    def unfinished(carry: Carry) -> jax.Array:
        *_, finished, count = carry
        return ~jnp.all(finished) & (count < _MOST_DOUBLINGS)

    def double(carry: Carry) -> Carry:
        E, G, H, previous, finished, count = carry
        VG, VE = split(divide(add(identity, times(G, H)), beside(G, E)))
        more_G = times(times(E, VG), transpose(E))
        more_H = times(times(transpose(E), H), VE)
        G, H = even(add(G, more_G)), even(add(H, more_H))
        change = jnp.maximum(_relative_size(rounded(more_G), rounded(G)), _relative_size(rounded(more_H), solution(H)))
        if terminal is None:
            # Convergence is quadratic: the change after one of sqrt(eps) is below eps.
            finished = ~(change > eps**0.5)
        else:
            # If a mode near the boundary of stability has no weight but the terminal one, each step first halves P,
            # until it is as small as the distance from the boundary: only then is convergence quadratic.
            finished = finished | ((change <= eps) & (change <= 0.25 * previous)) | ~jnp.isfinite(change)
        return times(E, VE), G, H, change, finished, count + 1

    E0, G0, H0 = number(problem.E), number(problem.G), number(problem.H)
    if terminal is not None:
        S, negative = number(terminal), number(-terminal)
        VG, VE = split(divide(add(identity, times(G0, S)), beside(G0, E0)))
        E0, G0, H0 = VE, even(VG), add(even(times(times(transpose(E0), S), VE)), add(H0, negative))
    finished = jnp.zeros(problem.E.shape[2:], dtype=bool)
    unknown = jnp.full(problem.E.shape[2:], jnp.inf, dtype=problem.E.dtype)
    carry = (E0, G0, H0, unknown, finished, jnp.zeros((), dtype=jnp.int32))
    _, G, H, _, finished, _ = lax.while_loop(unfinished, double, carry)
    # Without a terminal weight, and with a mode that is neither stable nor observable through Q, G grows until overflow
    # or rounding stops it, and does not solve the dual equation. (With a mode that no input moves, H does not solve
    # this equation, and Newton's method finds no solution.)
    again = rounded(add(G0, times(times(E0, divide(add(identity, times(G, H0)), G)), transpose(E0))))
    P = solution(H)
    G, H = rounded(G), rounded(H)
    plausible = (largest(again - G) <= 0.4 * largest(G)) & (jnp.sum(G * H, axis=(0, 1)) < 0.01 / eps**2)
    if terminal is not None:
        plausible = plausible & finished
    return _Start(P * problem.scale, plausible)


def _relative_size(change: Matrix, P: Matrix) -> jax.Array:
    """Returns the largest element of `change`, relative to the geometric mean of P's diagonal at its row and column."""
    root = jnp.sqrt(jnp.abs(diagonal(P)))
    finfo = np.finfo(P.dtype)
    return jnp.max(jnp.abs(change) / (root[:, None] * root[None] + finfo.eps * largest(P) + finfo.tiny), axis=(0, 1))


def _corrected(
    start: _Start,
    correction: Callable[[DoubleWord], Sum],
    gain: Callable[[DoubleWord], tuple[DoubleWord, DoubleWord]],
    valid: jax.Array,
) -> tuple[Matrix, Matrix]:
    """Applies Newton's method until P no longer changes; NaN where that, or anything before it, failed."""
    dtype, batch = start.P.dtype, start.P.shape[2:]
    eps = np.finfo(dtype).eps
    Carry: TypeAlias = tuple[DoubleWord, jax.Array, jax.Array, jax.Array, jax.Array]

    def unfinished(carry: Carry) -> jax.Array:
        _, size, previous, _, count = carry
        # The next correction is a small multiple of this one, or of its square, but only near the solution: the first
        # three may be of any size.
        ahead = (size < 0.5 * previous) | (count < 3)
        return jnp.any((size > eps**0.75) & ahead) & (count < _MOST_CORRECTIONS)

    def correct(carry: Carry) -> Carry:
        P, previous, _, _, count = carry
        X, stable = correction(P)
        P = dw.add(P, double_word(symmetric(X)))
        return P, _relative_size(X, P.high), previous, stable, count + 1

    unknown = jnp.full(batch, np.finfo(dtype).max, dtype=dtype)
    stable, count = jnp.zeros(batch, dtype=bool), jnp.zeros((), dtype=jnp.int32)
    carry = (double_word(start.P), unknown, jnp.full_like(unknown, jnp.inf), stable, count)
    P, size, _, stable, _ = lax.while_loop(unfinished, correct, carry)
    found = valid & start.plausible & stable & (size <= eps**0.75)
    return jnp.where(found, P.high, jnp.nan), jnp.where(found, gain(P)[0].high, jnp.nan)


def _weights_are_valid(Q: Matrix, R: Matrix, N: Matrix) -> jax.Array:
    """Returns whether R is positive definite and [[Q, N], [N', R]] positive semidefinite, to rounding."""
    H = symmetric(Q - product(N, inverse(R), transpose(N)))
    size = jnp.sqrt(jnp.abs(diagonal(Q)))
    size = jnp.where(size > 0.0, size, 1.0)
    room = 16.0 * H.shape[0] * np.finfo(H.dtype).eps * identity_like(H)
    return is_positive_definite(R) & is_positive_definite(H / (size[:, None] * size[None]) + room)


# --- derivatives, of plain matrices -----------------------------------------------------------------------------------


@jax.custom_jvp
def _continuous(A: jax.Array, B: jax.Array, Q: jax.Array, R: jax.Array, N: jax.Array) -> tuple[jax.Array, jax.Array]:
    return _solve_continuous(A, B, Q, R, N)


@jax.custom_jvp
def _discrete(A: jax.Array, B: jax.Array, Q: jax.Array, R: jax.Array, N: jax.Array) -> tuple[jax.Array, jax.Array]:
    return _solve_discrete(A, B, Q, R, N)


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

_Numbers: TypeAlias = np.ndarray[Any, Any]


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
