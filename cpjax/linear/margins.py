"""Stability margins of a loop u = -K s: gain, phase, delay and disk margins, and its poles.

The loop is broken at the plant's single input, L(s) = K (sI - A)^-1 B. All margins follow from the complementary
sensitivity T = L / (1 + L) = K (sI - A + B K)^-1 B on the imaginary axis, which is finite for a stable loop even where
the plant has poles there:

    |L| = 1       where  Re T = 1/2;  then T = 1/2 + y i and arg L = 2 atan(2 y)
    L real        where  Im T = 0;    a gain k puts a pole there if k = -1 / L = 1 - 1 / T
    |S - T| / 2   =      |T - 1/2|,   whose peak is 1 / (disk margin), S = 1 - T

The frequencies at which this happens are found in `_crossovers.py`.
"""

import math
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Real

from cpjax.linear._crossovers import (
    Crossovers,
    Loop,
    above_half,
    epsilon,
    excess,
    excess_slope,
    gain_candidates,
    imaginary_part,
    level_candidates,
    phase_candidates,
    root_near,
    roots_near,
    transfer,
)
from cpjax.linear.arguments import MatrixLike, column, columns, gain_matrix, matrices, square
from cpjax.numeric.selection import where


class Margins(NamedTuple):
    """Margins of a stable loop at the plant's input; for an unstable loop all but `stable` are NaN.

    The frequency of an unlimited margin is NaN.
    """

    stable: Bool[Array, ""]
    """Whether every closed-loop pole has a negative real part."""
    gain_lower: Float[Array, ""]
    """Factor below 1 down to which the loop gain may fall; 0 if unlimited, above 0 if the plant itself is unstable."""
    gain_lower_frequency: Float[Array, ""]
    """Phase crossover at which the loop would oscillate [rad/s]; 0 if a real pole would cross the axis."""
    gain_upper: Float[Array, ""]
    """Factor above 1 up to which the loop gain may rise; inf if unlimited."""
    gain_upper_frequency: Float[Array, ""]
    """Phase crossover at which the loop would oscillate [rad/s]; 0 if a real pole would cross the axis."""
    phase: Float[Array, ""]
    """Phase lag or lead, whichever is less, that destabilises the loop [rad]; inf if |L| = 1 nowhere."""
    phase_frequency: Float[Array, ""]
    """Gain crossover that limits `phase` [rad/s]."""
    delay: Float[Array, ""]
    """Delay that destabilises the loop [s]; inf if |L| = 1 nowhere."""
    delay_frequency: Float[Array, ""]
    """Gain crossover that limits `delay` [rad/s]; not that of `phase` where a lead or a faster crossover decides."""
    disk: Float[Array, ""]
    """Disk margin alpha in (0, 2], of skew 0: 1 / max |S - 1/2| = 2 / max |S - T|."""
    disk_frequency: Float[Array, ""]
    """Frequency of that maximum [rad/s]; inf where alpha is 2, the limit at high frequencies."""
    disk_gain: Float[Array, ""]
    """g = (2 + alpha) / (2 - alpha), above 1: the disk contains every gain factor in (1/g, g)."""
    disk_phase: Float[Array, ""]
    """2 atan(alpha / 2), at most pi / 2 [rad]: the disk contains every phase lag and lead below it."""


def closed_loop_poles(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n m"] | Real[MatrixLike, " n"],
    K: Real[MatrixLike, "m n"] | Real[MatrixLike, " n"],
) -> Complex[Array, " n"]:
    """Computes the poles of the loop u = -K s, the eigenvalues of A - B K.

    Where poles coincide they are not differentiable, and rounding splits a pole of multiplicity m by up to about
    eps^(1/m) of the largest: derivatives there are infinite, NaN or undefined. `characteristic_polynomial` is smooth.

    Args:
      A: state matrix [1/s].
      B: input matrix; a vector for one input.
      K: gain; a vector for one input.

    Returns:
      The poles [1/s], sorted by real part, then imaginary part (of a conjugate pair the lower one first).

    Raises:
      InputError: not finite real matrices of these shapes.
    """
    A, B, K = matrices(A=A, B=B, K=K)
    n = square("A", A)
    B = columns("B", B, n)
    K = gain_matrix("K", K, B.shape[1], n)
    return jnp.sort(jnp.linalg.eigvals(A - B @ K))


def characteristic_polynomial(A: Real[MatrixLike, "n n"]) -> Float[Array, " n"]:
    """Computes the coefficients of det(sI - A), smooth also where eigenvalues coincide.

    Uses the recursion of Faddeev and LeVerrier. The k-th coefficient has an absolute error of about eps times the k-th
    power of the norm of A, so that small ones are lost if eigenvalues differ strongly in size.

    Args:
      A: any square matrix.

    Returns:
      The coefficients, highest power first, without the leading 1.

    Raises:
      InputError: not a finite real square matrix.
    """
    (A,) = matrices(A=A)
    return _resolvent(A, square("A", A))[0]


def loop_polynomials(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n 1"] | Real[MatrixLike, " n"],
    K: Real[MatrixLike, "1 n"] | Real[MatrixLike, " n"],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Computes numerator N and denominator D of L(s) = K (sI - A)^-1 B; the closed loop's polynomial is N + D.

    Args:
      A: state matrix.
      B: input matrix of one input.
      K: gain.

    Returns:
      N, from s^(n-1) down, and D, of the same powers, without its leading 1.

    Raises:
      InputError: not finite real matrices of these shapes.
    """
    A, B, K = _single_input(A, B, K)
    D, adjugate = _resolvent(A, A.shape[0])
    return jnp.stack([K @ M @ B for M in adjugate]), D


def stability_margins(
    A: Real[MatrixLike, "n n"],
    B: Real[MatrixLike, "n 1"] | Real[MatrixLike, " n"],
    K: Real[MatrixLike, "1 n"] | Real[MatrixLike, " n"],
) -> Margins:
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
      A: state matrix [1/s].
      B: input matrix of one input.
      K: gain.

    Returns:
      The margins and the frequencies that limit them.

    Raises:
      InputError: not finite real matrices of these shapes. An unstable loop is no error: its margins are NaN.
    """
    return _margins(*_single_input(A, B, K))


margins = stability_margins
"""The name until version 0.1."""


@jax.jit
def _margins(A: jax.Array, B: jax.Array, K: jax.Array) -> Margins:
    closed = A - jnp.outer(B, K)
    poles = jnp.linalg.eigvals(lax.stop_gradient(closed))  # for scale and stability only; gradient NaN where two meet
    stable = jnp.all(poles.real < 0.0)
    # A stable replacement keeps numbers and derivatives finite where the result will be NaN.
    closed = where(stable, closed, -jnp.eye(A.shape[0], dtype=A.dtype))
    poles = where(stable, poles, -jnp.ones_like(poles))
    loop = Loop(closed, B, K)
    scale = jnp.exp(jnp.mean(jnp.log(jnp.abs(poles))))

    fixed = lax.stop_gradient(loop)  # only guesses; `tied` differentiates their roots
    lower, upper = _gain_margins(roots_near(imaginary_part, phase_candidates(fixed, scale), loop, scale), loop)
    crossovers = roots_near(above_half, gain_candidates(fixed), loop, scale)
    phase, delay = _phase_and_delay_margins(crossovers, loop)
    peak, frequency = _peak(loop, scale, jnp.concatenate([jnp.abs(poles), jnp.abs(poles.imag), crossovers.frequency]))
    root = jnp.sqrt(1.0 + 4.0 * peak)  # twice the largest |T - 1/2|
    bounded = peak > 0.0
    disk_gain = where(bounded, (root + 1.0) ** 2 / (4.0 * where(bounded, peak, 1.0)), jnp.inf)
    found = (*lower, *upper, *phase, *delay, 2.0 / root, frequency, disk_gain, 2.0 * jnp.arctan(1.0 / root))
    return Margins(stable, *(where(stable, value, jnp.nan) for value in found))


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


def _gain_margins(crossovers: Crossovers, loop: Loop) -> tuple[_Margin, _Margin]:
    """Returns the lower and the upper gain margin, from all real values of T; that at frequency 0 is always one."""
    frequency = jnp.pad(crossovers.frequency, (1, 0))
    valid = jnp.pad(crossovers.valid, (1, 0), constant_values=True)
    T = jax.vmap(transfer, in_axes=(0, None))(frequency, loop).real
    tolerance = math.sqrt(epsilon(T))
    below, above = valid & (T * (1.0 - tolerance) > 1.0), valid & (T + tolerance < 0.0)
    factor = 1.0 - 1.0 / where(below | above, T, 1.0)
    lower = _pick(jnp.argmax(where(below, T, -jnp.inf)), below, factor, frequency, 0.0)
    upper = _pick(jnp.argmin(where(above, T, jnp.inf)), above, factor, frequency, jnp.inf)
    return lower, upper


def _phase_and_delay_margins(crossovers: Crossovers, loop: Loop) -> tuple[_Margin, _Margin]:
    frequency, valid = crossovers
    y = jax.vmap(transfer, in_axes=(0, None))(frequency, loop).imag
    phase = 2.0 * jnp.arctan2(jnp.full_like(y, 0.5), jnp.abs(y))  # pi - |arg L|
    delay = (math.pi + 2.0 * jnp.arctan(2.0 * y)) / frequency  # a delay only lags: (pi + arg L) / frequency

    def least(values: jax.Array) -> _Margin:
        return _pick(jnp.argmin(where(valid, values, jnp.inf)), valid, values, frequency, jnp.inf)

    return least(phase), least(delay)


def _pick(index: jax.Array, valid: jax.Array, values: jax.Array, frequencies: jax.Array, otherwise: float) -> _Margin:
    return where(valid[index], values[index], otherwise), where(valid[index], frequencies[index], jnp.nan)


class _Ascent(NamedTuple):
    """State of the search for the peak."""

    level: jax.Array
    frequency: jax.Array
    rising: jax.Array
    rounds: jax.Array


def _peak(loop: Loop, scale: jax.Array, frequencies: jax.Array) -> _Margin:
    """Returns the maximum of `excess` and its frequency; 0 and inf where it is not positive.

    Method: level by level after Bruinsma and Steinbuch (1990). The axis candidates of a level bound the intervals that
    rise above it, and the highest value at the middles of these intervals is the next level. It finds a peak of any
    width.
    """
    fixed = lax.stop_gradient(loop)  # not differentiated: at a maximum the frequency's derivative does not count
    tolerance = math.sqrt(epsilon(scale))

    def higher(ascent: _Ascent, frequencies: jax.Array) -> _Ascent:
        found = jax.vmap(excess, in_axes=(0, None))(frequencies, fixed)
        top = jnp.argmax(found)
        level, frequency = lax.cond(
            found[top] > ascent.level,
            lambda: (found[top], frequencies[top]),
            lambda: (ascent.level, ascent.frequency),
        )
        return _Ascent(level, frequency, level > (1.0 + tolerance) * ascent.level, ascent.rounds + 1)

    def rise(ascent: _Ascent) -> _Ascent:
        edges = level_candidates(fixed, ascent.level)
        below = jnp.pad(edges[:-1], (1, 0))
        # Both means, because the edges may be decades apart, or one of them a 0 displaced by rounding.
        return higher(ascent, jnp.concatenate([0.5 * (below + edges), jnp.sqrt(below * edges)]))

    rounds = jnp.zeros((), dtype=jnp.int32)
    flat = _Ascent(jnp.full_like(scale, tolerance), jnp.full_like(scale, jnp.inf), rounds == 0, rounds)
    first = lax.stop_gradient(jnp.pad(frequencies, (1, 0)))  # the result does not depend on the initial frequencies
    ascent = higher(flat, first)._replace(rising=rounds == 0)
    ascent = lax.while_loop(lambda ascent: ascent.rising & (ascent.rounds < 30), rise, ascent)

    bounded = jnp.isfinite(ascent.frequency)
    polished, valid = root_near(excess_slope, where(bounded, ascent.frequency, 0.0), loop, scale)
    # Newton's method may have gone to another stationary point.
    same = valid & (excess(polished, fixed) > 0.999 * ascent.level)
    frequency = where(same, polished, ascent.frequency)
    return where(bounded, excess(where(bounded, frequency, scale), loop), 0.0), frequency
