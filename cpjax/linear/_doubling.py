"""Solutions of the algebraic Riccati equations, in batches: doubling, then Newton's method; see `riccati.py`.

A structure-preserving doubling algorithm (Anderson, 1978; Chu, Fan and Lin, 2005) finds P to most of its
digits. Newton's method (Kleinman, 1964; Hewer, 1971) corrects it, with the residual, P and K in double-word arithmetic,
so that the result is the rounded exact solution, unless the problem is too ill-conditioned for the dtype. Each
correction solves a Lyapunov or Stein equation, which also proves the closed loop stable. Where this fails, it is
repeated with doubling in double-word arithmetic and with a weight at the end of the horizon: P and the solution of the
dual equation may be so large that doubling lost all digits, or an unstable mode may be unobservable through Q, in which
case doubling without that weight finds a solution that does not stabilise.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from cpjax.linear.lyapunov import Sum, cayley_shift, sum_continuous, sum_discrete
from cpjax.numeric import double_word as dw
from cpjax.numeric.double_word import DoubleWord, double_word
from cpjax.numeric.selection import where
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
    product,
    solve,
    symmetric,
    transpose,
)
from cpjax.pytree import is_traced

_MOST_DOUBLINGS = 60
_MOST_CORRECTIONS = 12


def _continuous(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, N: Matrix, *, attempts: int = 2) -> tuple[Matrix, Matrix]:
    """Returns P and K of the continuous-time equation, matrix axes first; NaN where there are none."""
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

    return _found(_cayley(A, B, Q, R, N), correction, gain, _weights_are_valid(Q, R, N), attempts)


def _discrete(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, N: Matrix, *, attempts: int = 2) -> tuple[Matrix, Matrix]:
    """Returns P and K of the discrete-time equation, matrix axes first; NaN where there are none."""
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
    return _found(doubled, correction, gain, _weights_are_valid(Q, R, N), attempts)


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
    attempts: int,
) -> tuple[Matrix, Matrix]:
    """Returns P and K, NaN where there are none. The second attempt is made only if a batch element needs it."""
    P, K = _corrected(_double(problem, _PLAIN), correction, gain, valid)
    if attempts == 1:
        return P, K
    finite = jnp.all(jnp.isfinite(problem.E + problem.G + problem.H), axis=(0, 1))
    missed = valid & finite & ~jnp.all(jnp.isfinite(P), axis=(0, 1))

    def again() -> tuple[Matrix, Matrix]:
        start = _double(problem, _ACCURATE, _terminal_weight(problem))
        more = _corrected(start, correction, gain, missed)
        return where(missed, more[0], P), where(missed, more[1], K)

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
    return identity * where((weight > 0.0) & jnp.isfinite(weight), weight, 0.0)


def _without_cross_term(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, N: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """Returns A, G = B R^-1 B' and H = Q of the equivalent equation with N = 0."""
    weight = inverse(R)
    H = symmetric(Q - product(N, weight, transpose(N)))
    return A - product(B, weight, transpose(N)), symmetric(product(B, weight, transpose(B))), H


def _balance(G: Matrix, H: Matrix) -> jax.Array:
    """Returns the factor that makes G and H equally large; P is scaled by its reciprocal."""
    scale = jnp.sqrt(largest(H) / largest(G))
    return where((scale > 0.0) & jnp.isfinite(scale), scale, 1.0)


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
        return resolvent, coupled, where(jnp.isfinite(size), size, jnp.inf)

    # The shift is near the geometric mean of the closed loop's eigenvalues; the factors prevent it from being an
    # eigenvalue of A by construction. It may still be one by chance: of two shifts, the one farther away is taken.
    *one, near = inverses(1.0987 * shift)
    *other, far = inverses(1.4321 * shift)
    resolvent, coupled = (where(near <= far, x, y) for x, y in zip(one, other, strict=True))
    shift = where(near <= far, 1.0987, 1.4321) * shift
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
    return where(found, P.high, jnp.nan), where(found, gain(P)[0].high, jnp.nan)


def _weights_are_valid(Q: Matrix, R: Matrix, N: Matrix) -> jax.Array:
    """Returns whether R is positive definite and [[Q, N], [N', R]] positive semidefinite, to rounding."""
    H = symmetric(Q - product(N, inverse(R), transpose(N)))
    size = jnp.sqrt(jnp.abs(diagonal(Q)))
    size = where(size > 0.0, size, 1.0)
    room = 16.0 * H.shape[0] * np.finfo(H.dtype).eps * identity_like(H)
    return is_positive_definite(R) & is_positive_definite(H / (size[:, None] * size[None]) + room)


def _solver(solve: Callable[..., tuple[Matrix, Matrix]]) -> Callable[..., tuple[Matrix, Matrix]]:
    """Returns the compiled solver of an equation.

    For known matrices the first attempt, which nearly always suffices, is a program of its own: the second is then not
    compiled either.
    """
    first = jax.jit(functools.partial(solve, attempts=1))
    both = batch_last(jax.jit(solve))

    @functools.wraps(solve)
    def solved(*problem: Matrix) -> tuple[Matrix, Matrix]:
        if not any(is_traced(matrix) for matrix in problem):
            P, K = first(*problem)
            if np.all(np.isfinite(P)):
                return P, K
        return both(*problem)

    return solved


solve_continuous = _solver(_continuous)
solve_discrete = _solver(_discrete)
