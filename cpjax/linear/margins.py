"""Stability margins of a loop u = -K s: gain, phase, delay and disk margins, and its poles.

The loop is broken at the plant's single input, L(s) = K (sI - A)^-1 B. All margins follow from the complementary
sensitivity T = L / (1 + L) = K (sI - A + B K)^-1 B on the imaginary axis, which is finite for a stable loop even where
the plant has poles there:

    |L| = 1       where  Re T = 1/2;  then T = 1/2 + y i and arg L = 2 atan(2 y)
    L real        where  Im T = 0;    a gain k puts a pole there if k = -1 / L = 1 - 1 / T
    |S - T| / 2   =      |T - 1/2|,   whose peak is 1 / (disk margin), S = 1 - T

The frequencies at which this happens are zeros of functions of T(s) and T(-s), found as eigenvalues of a matrix (no
grid could miss one), polished by Newton's method, and differentiated by the implicit function theorem.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from cpjax.linear.arguments import column, columns, gain_matrix, matrices, square


class Margins(NamedTuple):
    """Margins of a stable loop at the plant's input, all scalars; for an unstable loop all but `stable` are NaN.

    The frequency of an unlimited margin is NaN.
    """

    stable: jax.Array
    """Whether every closed-loop pole has a negative real part."""
    gain_lower: jax.Array
    """Factor below 1 down to which the loop gain may fall; 0 if unlimited, above 0 if the plant itself is unstable."""
    gain_lower_frequency: jax.Array
    """Phase crossover at which the loop would oscillate [rad/s]; 0 if a real pole would cross the axis."""
    gain_upper: jax.Array
    """Factor above 1 up to which the loop gain may rise; inf if unlimited."""
    gain_upper_frequency: jax.Array
    """Phase crossover at which the loop would oscillate [rad/s]; 0 if a real pole would cross the axis."""
    phase: jax.Array
    """Phase lag or lead, whichever is less, that destabilises the loop [rad]; inf if |L| = 1 nowhere."""
    phase_frequency: jax.Array
    """Gain crossover that limits `phase` [rad/s]."""
    delay: jax.Array
    """Delay that destabilises the loop [s]; inf if |L| = 1 nowhere."""
    delay_frequency: jax.Array
    """Gain crossover that limits `delay` [rad/s]; not that of `phase` where a lead or a faster crossover decides."""
    disk: jax.Array
    """Disk margin alpha in (0, 2], of skew 0: 1 / max |S - 1/2| = 2 / max |S - T|."""
    disk_frequency: jax.Array
    """Frequency of that maximum [rad/s]; inf where alpha is 2, the limit at high frequencies."""
    disk_gain: jax.Array
    """g = (2 + alpha) / (2 - alpha), above 1: the disk contains every gain factor in (1/g, g)."""
    disk_phase: jax.Array
    """2 atan(alpha / 2), at most pi / 2 [rad]: the disk contains every phase lag and lead below it."""


def closed_loop_poles(A: Any, B: Any, K: Any) -> jax.Array:
    """Computes the poles of the loop u = -K s, the eigenvalues of A - B K.

    Where poles coincide they are not differentiable, and rounding splits a pole of multiplicity m by up to about
    eps^(1/m) of the largest: derivatives there are infinite, NaN or undefined. `characteristic_polynomial` is smooth.

    Args:
      A: shape (n, n) [1/s].
      B: shape (n, m), or (n,) for one input.
      K: shape (m, n), or (n,) for one input.

    Returns:
      Complex, shape (n,) [1/s], sorted by real part, then imaginary part (of a conjugate pair the lower one first).

    Raises:
      InputError: not finite real matrices of these shapes.
    """
    A, B, K = matrices(A=A, B=B, K=K)
    n = square("A", A)
    B = columns("B", B, n)
    K = gain_matrix("K", K, B.shape[1], n)
    return jnp.sort(jnp.linalg.eigvals(A - B @ K))


def characteristic_polynomial(A: Any) -> jax.Array:
    """Computes the coefficients of det(sI - A), smooth also where eigenvalues coincide.

    Uses the recursion of Faddeev and LeVerrier. The k-th coefficient has an absolute error of about eps times the k-th
    power of the norm of A, so that small ones are lost if eigenvalues differ strongly in size.

    Args:
      A: shape (n, n).

    Returns:
      Shape (n,), highest power first, without the leading 1.

    Raises:
      InputError: not a finite real square matrix.
    """
    (A,) = matrices(A=A)
    return _resolvent(A, square("A", A))[0]


def loop_polynomials(A: Any, B: Any, K: Any) -> tuple[jax.Array, jax.Array]:
    """Computes numerator N and denominator D of L(s) = K (sI - A)^-1 B; the closed loop's polynomial is N + D.

    Args:
      A: shape (n, n).
      B: shape (n, 1) or (n,).
      K: shape (1, n) or (n,).

    Returns:
      N, shape (n,), from s^(n-1) down, and D, shape (n,), of the same powers, without its leading 1.

    Raises:
      InputError: not finite real matrices of these shapes.
    """
    A, B, K = _single_input(A, B, K)
    D, adjugate = _resolvent(A, A.shape[0])
    return jnp.stack([K @ M @ B for M in adjugate]), D


def margins(A: Any, B: Any, K: Any) -> Margins:
    """Computes the margins of the continuous-time loop u = -K s, broken at the plant's input.

    The two gain margins bound the interval around 1 of the factors on K that keep the loop stable. The phase margin is
    that of Seiler, Packard and Gahinet, "An introduction to disk margins" (2020): the lesser of lag and lead. The delay
    margin is the least lag over frequency among all gain crossovers. The disk margin, also defined there, allows gain
    and phase to change together: by a factor (2 + d) / (2 - d) with any complex |d| < alpha.

    A gain factor below sqrt(eps) counts as 0 and one above 1 / sqrt(eps) as infinite. On the paper's loops float64 is
    accurate to 1e-13 and float32 to 1e-4. The larger the gain, the more digits cancel: with entries of K beyond 1e5
    float32 can miss a crossover.

    Differentiable in A, B and K to any order as long as the same crossover limits a margin; where another one takes
    over, the derivative is that of one side. Values that are 0, infinite or NaN have the derivative 0.

    Args:
      A: shape (n, n) [1/s].
      B: shape (n, 1) or (n,).
      K: shape (1, n) or (n,).

    Raises:
      InputError: not finite real matrices of these shapes. An unstable loop is no error: its margins are NaN.
    """
    return _margins(*_single_input(A, B, K))


@jax.jit
def _margins(A: jax.Array, B: jax.Array, K: jax.Array) -> Margins:
    closed = A - jnp.outer(B, K)
    poles = jnp.linalg.eigvals(lax.stop_gradient(closed))  # for scale and stability only; gradient NaN where two meet
    stable = jnp.all(poles.real < 0.0)
    # A stable replacement keeps numbers and derivatives finite where the result will be NaN.
    closed = jnp.where(stable, closed, -jnp.eye(A.shape[0], dtype=A.dtype))
    poles = jnp.where(stable, poles, -jnp.ones_like(poles))
    loop = _Loop(closed, B, K)
    scale = jnp.exp(jnp.mean(jnp.log(jnp.abs(poles))))

    fixed = lax.stop_gradient(loop)  # only guesses; `_tied` differentiates their roots
    lower, upper = _gain_margins(_crossovers(_imaginary_part, _phase_candidates(fixed, scale), loop, scale), loop)
    crossovers = _crossovers(_above_half, _gain_candidates(fixed), loop, scale)
    phase, delay = _phase_and_delay_margins(crossovers, loop)
    excess, frequency = _peak(loop, scale, jnp.concatenate([jnp.abs(poles), jnp.abs(poles.imag), crossovers.frequency]))
    root = jnp.sqrt(1.0 + 4.0 * excess)  # twice the peak of |T - 1/2|
    bounded = excess > 0.0
    disk_gain = jnp.where(bounded, (root + 1.0) ** 2 / (4.0 * jnp.where(bounded, excess, 1.0)), jnp.inf)
    found = (*lower, *upper, *phase, *delay, 2.0 / root, frequency, disk_gain, 2.0 * jnp.arctan(1.0 / root))
    return Margins(stable, *(jnp.where(stable, value, jnp.nan) for value in found))


class _Loop(NamedTuple):
    """Realisation of T(s) = K (sI - F)^-1 B, with F = A - B K."""

    F: jax.Array
    B: jax.Array
    K: jax.Array


class _Crossovers(NamedTuple):
    """Frequencies [rad/s]; only those marked `valid` are crossovers."""

    frequency: jax.Array
    valid: jax.Array


_OfFrequency: TypeAlias = Callable[[jax.Array, _Loop], jax.Array]

_Margin: TypeAlias = tuple[jax.Array, jax.Array]
"""Value and frequency."""


def _single_input(A: Any, B: Any, K: Any) -> list[jax.Array]:
    """Returns A (n, n), B (n,) and K (n,) of a loop with one input."""
    A, B, K = matrices(A=A, B=B, K=K)
    n = square("A", A)
    B = column("B", B, n)
    return [A, B[:, 0], gain_matrix("K", K, 1, n)[0]]


def _resolvent(A: jax.Array, n: int) -> tuple[jax.Array, list[jax.Array]]:
    """Returns the coefficients of det(sI - A) and the matrices of adj(sI - A), from the highest power of s down."""
    identity = jnp.eye(n, dtype=A.dtype)
    adjugate, coefficients = [identity], []
    for k in range(1, n + 1):
        product = A @ adjugate[-1]
        coefficients.append(-jnp.trace(product) / k)
        adjugate.append(product + coefficients[-1] * identity)
    return jnp.stack(coefficients), adjugate[:-1]


def _transfer(frequency: jax.Array, loop: _Loop) -> jax.Array:
    """Computes T at s = i `frequency`."""
    n = loop.F.shape[0]
    resolvent = lax.complex(-loop.F, frequency * jnp.eye(n, dtype=loop.F.dtype))
    states = jnp.linalg.solve(resolvent, lax.complex(loop.B, jnp.zeros_like(loop.B)))
    return lax.complex(loop.K @ states.real, loop.K @ states.imag)


def _above_half(frequency: jax.Array, loop: _Loop) -> jax.Array:
    return _transfer(frequency, loop).real - 0.5


def _imaginary_part(frequency: jax.Array, loop: _Loop) -> jax.Array:
    return _transfer(frequency, loop).imag


def _excess(frequency: jax.Array, loop: _Loop) -> jax.Array:
    """Computes |T - 1/2|^2 - 1/4 without cancellation."""
    T = _transfer(frequency, loop)
    return T.real * T.real + T.imag * T.imag - T.real


def _excess_slope(frequency: jax.Array, loop: _Loop) -> jax.Array:
    return _with_slope(_excess, frequency, loop)[1]


def _with_slope(function: _OfFrequency, frequency: jax.Array, loop: _Loop) -> tuple[jax.Array, jax.Array]:
    """Returns value and derivative with respect to frequency."""
    return jax.jvp(lambda w: function(w, loop), (frequency,), (jnp.ones_like(frequency),))


def _gain_candidates(loop: _Loop) -> jax.Array:
    """Returns candidates for zeros of T(s) + T(-s) - 1 on the imaginary axis."""
    feedback = jnp.outer(loop.B, loop.K)
    plant = loop.F + feedback
    return _on_axis(jnp.linalg.eigvals(jnp.block([[plant, -feedback], [feedback, -plant]])))


def _phase_candidates(loop: _Loop, scale: jax.Array) -> jax.Array:
    """Returns candidates for zeros of T(s) - T(-s) on the imaginary axis.

    It vanishes at infinity, so they come from the inverse of its system pencil at a shift.
    """
    n = loop.F.shape[0]
    shift = 0.7390851332151607 * scale  # real; with this factor it is unlikely to be a zero itself
    B, K = loop.B * (scale / _largest(loop.B)), loop.K * (scale / _largest(loop.K))
    one, zero = shift * jnp.eye(n, dtype=scale.dtype), jnp.zeros_like(loop.F)
    pencil = jnp.block(
        [
            [one - loop.F, zero, -B[:, None]],
            [zero, one + loop.F, -B[:, None]],
            [K[None, :], K[None, :], jnp.zeros((1, 1), dtype=scale.dtype)],
        ]
    )
    inverse = jnp.linalg.solve(pencil, jnp.eye(2 * n + 1, 2 * n, dtype=scale.dtype))[: 2 * n]
    return _on_axis(-1.0 / jnp.linalg.eigvals(inverse))  # the zeros minus the shift


def _level_candidates(loop: _Loop, level: jax.Array) -> jax.Array:
    """Returns candidates for axis zeros of T(s) T(-s) - (T(s) + T(-s)) / 2 - level, where `_excess` is the level."""
    feedback = jnp.outer(loop.B, loop.K) / level
    half, lower = 0.5 * feedback, (level + 0.25) * feedback
    return _on_axis(jnp.linalg.eigvals(jnp.block([[loop.F - half, -feedback], [lower, half - loop.F]])))


def _on_axis(zeros: jax.Array) -> jax.Array:
    """Returns candidate frequencies (n,), ascending and padded with 0, from zeros (2n,) in conjugate pairs.

    No zero is rejected for its real part, which is subject to rounding: a superfluous candidate does no harm.
    """
    usable = jnp.isfinite(zeros.imag) & (zeros.imag > 0.0)
    return jnp.sort(jnp.where(usable, zeros.imag, 0.0))[zeros.shape[0] // 2 :]


def _largest(vector: jax.Array) -> jax.Array:
    largest = jnp.max(jnp.abs(vector))
    return jnp.where(largest > 0.0, largest, 1.0)


def _epsilon(array: jax.Array) -> float:
    return float(np.finfo(array.dtype).eps)


def _crossovers(condition: _OfFrequency, guesses: jax.Array, loop: _Loop, scale: jax.Array) -> _Crossovers:
    """Returns the root of `condition` near each guess, with its derivative with respect to the loop."""
    return jax.vmap(partial(_root, condition), in_axes=(0, None, None))(guesses, loop, scale)


def _root(condition: _OfFrequency, guess: jax.Array, loop: _Loop, scale: jax.Array) -> _Crossovers:
    """Returns the positive root of `condition` near a guess, marked valid where Newton's steps have become short.

    Without a root on the axis they do not: for a zero at a distance d from the axis they stay longer than d.
    """
    fixed = lax.stop_gradient(loop)  # the iteration is not differentiated; `_tied` differentiates the equation

    def newton(_: Any, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        frequency, _ = carry
        value, slope = _with_slope(condition, frequency, fixed)
        step = jnp.where(value == 0.0, 0.0, value / slope)
        return jnp.abs(frequency - jnp.clip(step, -frequency, frequency)), jnp.abs(step)

    start = jnp.where(guess > 0.0, guess, scale)
    frequency, step = lax.fori_loop(0, 5, newton, (start, start))
    valid = (guess > 0.0) & (frequency > 0.0) & (step <= _epsilon(guess) ** (1 / 3) * frequency)
    frequency = _tied(condition, jnp.where(valid, frequency, scale), loop)
    return _Crossovers(jnp.where(valid, frequency, scale), valid)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _tied(condition: _OfFrequency, frequency: jax.Array, loop: _Loop) -> jax.Array:
    """Returns `frequency`, a root of `condition`, with its derivative with respect to the loop."""
    return frequency


@_tied.defjvp
def _tied_jvp(
    condition: _OfFrequency, primals: tuple[jax.Array, _Loop], tangents: tuple[jax.Array, _Loop]
) -> tuple[jax.Array, jax.Array]:
    frequency, loop = primals
    frequency = _tied(condition, frequency, loop)
    _, slope = _with_slope(condition, frequency, loop)
    _, change = jax.jvp(lambda moved: condition(frequency, moved), (loop,), (tangents[1],))
    return frequency, -change / jnp.where(slope == 0.0, jnp.inf, slope)


def _gain_margins(crossovers: _Crossovers, loop: _Loop) -> tuple[_Margin, _Margin]:
    """Returns the lower and the upper gain margin, from all real values of T; that at frequency 0 is always one."""
    frequency = jnp.pad(crossovers.frequency, (1, 0))
    valid = jnp.pad(crossovers.valid, (1, 0), constant_values=True)
    T = jax.vmap(_transfer, in_axes=(0, None))(frequency, loop).real
    tolerance = math.sqrt(_epsilon(T))
    below, above = valid & (T * (1.0 - tolerance) > 1.0), valid & (T + tolerance < 0.0)
    factor = 1.0 - 1.0 / jnp.where(below | above, T, 1.0)
    lower = _pick(jnp.argmax(jnp.where(below, T, -jnp.inf)), below, factor, frequency, 0.0)
    upper = _pick(jnp.argmin(jnp.where(above, T, jnp.inf)), above, factor, frequency, jnp.inf)
    return lower, upper


def _phase_and_delay_margins(crossovers: _Crossovers, loop: _Loop) -> tuple[_Margin, _Margin]:
    frequency, valid = crossovers
    y = jax.vmap(_transfer, in_axes=(0, None))(frequency, loop).imag
    phase = 2.0 * jnp.arctan2(jnp.full_like(y, 0.5), jnp.abs(y))  # pi - |arg L|
    delay = (math.pi + 2.0 * jnp.arctan(2.0 * y)) / frequency  # a delay only lags: (pi + arg L) / frequency

    def least(values: jax.Array) -> _Margin:
        return _pick(jnp.argmin(jnp.where(valid, values, jnp.inf)), valid, values, frequency, jnp.inf)

    return least(phase), least(delay)


def _pick(index: jax.Array, valid: jax.Array, values: jax.Array, frequencies: jax.Array, otherwise: float) -> _Margin:
    return jnp.where(valid[index], values[index], otherwise), jnp.where(valid[index], frequencies[index], jnp.nan)


class _Ascent(NamedTuple):
    """State of the search for the peak."""

    level: jax.Array
    frequency: jax.Array
    rising: jax.Array
    rounds: jax.Array


def _peak(loop: _Loop, scale: jax.Array, frequencies: jax.Array) -> _Margin:
    """Returns the maximum of `_excess` and its frequency; 0 and inf where it is not positive.

    Method: level by level after Bruinsma and Steinbuch (1990). The axis candidates of a level bound the intervals that
    rise above it, and the highest value at the middles of these intervals is the next level. It finds a peak of any
    width.
    """
    fixed = lax.stop_gradient(loop)  # not differentiated: at a maximum the frequency's derivative does not count
    tolerance = math.sqrt(_epsilon(scale))

    def higher(ascent: _Ascent, frequencies: jax.Array) -> _Ascent:
        found = jax.vmap(_excess, in_axes=(0, None))(frequencies, fixed)
        top = jnp.argmax(found)
        level, frequency = lax.cond(
            found[top] > ascent.level,
            lambda: (found[top], frequencies[top]),
            lambda: (ascent.level, ascent.frequency),
        )
        return _Ascent(level, frequency, level > (1.0 + tolerance) * ascent.level, ascent.rounds + 1)

    def rise(ascent: _Ascent) -> _Ascent:
        edges = _level_candidates(fixed, ascent.level)
        below = jnp.pad(edges[:-1], (1, 0))
        # Both means, because the edges may be decades apart, or one of them a 0 displaced by rounding.
        return higher(ascent, jnp.concatenate([0.5 * (below + edges), jnp.sqrt(below * edges)]))

    rounds = jnp.zeros((), dtype=jnp.int32)
    flat = _Ascent(jnp.full_like(scale, tolerance), jnp.full_like(scale, jnp.inf), rounds == 0, rounds)
    first = lax.stop_gradient(jnp.pad(frequencies, (1, 0)))  # the result does not depend on the initial frequencies
    ascent = higher(flat, first)._replace(rising=rounds == 0)
    ascent = lax.while_loop(lambda ascent: ascent.rising & (ascent.rounds < 30), rise, ascent)

    bounded = jnp.isfinite(ascent.frequency)
    polished, valid = _root(_excess_slope, jnp.where(bounded, ascent.frequency, 0.0), loop, scale)
    # Newton's method may have gone to another stationary point.
    same = valid & (_excess(polished, fixed) > 0.999 * ascent.level)
    frequency = jnp.where(same, polished, ascent.frequency)
    return jnp.where(bounded, _excess(jnp.where(bounded, frequency, scale), loop), 0.0), frequency
