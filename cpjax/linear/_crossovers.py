"""Frequencies at which a transfer function on the imaginary axis meets a condition.

They are the zeros of a function of T(s) and T(-s), found as eigenvalues of a matrix (no grid could miss one), polished
by Newton's method, and differentiated by the implicit function theorem. T is the complementary sensitivity of a stable
loop with one input, T(s) = K (sI - F)^-1 B.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from cpjax.numeric.selection import where


class Loop(NamedTuple):
    """Realisation of T(s) = K (sI - F)^-1 B, with F = A - B K."""

    F: jax.Array
    B: jax.Array
    K: jax.Array


class Crossovers(NamedTuple):
    """Frequencies [rad/s]; only those marked `valid` are crossovers."""

    frequency: jax.Array
    valid: jax.Array


_OfFrequency: TypeAlias = Callable[[jax.Array, Loop], jax.Array]


def transfer(frequency: jax.Array, loop: Loop) -> jax.Array:
    """Computes T at s = i `frequency`."""
    n = loop.F.shape[0]
    resolvent = lax.complex(-loop.F, frequency * jnp.eye(n, dtype=loop.F.dtype))
    states = jnp.linalg.solve(resolvent, lax.complex(loop.B, jnp.zeros_like(loop.B)))
    return lax.complex(loop.K @ states.real, loop.K @ states.imag)


def above_half(frequency: jax.Array, loop: Loop) -> jax.Array:
    """Computes Re T - 1/2, which is 0 where |L| = 1."""
    return transfer(frequency, loop).real - 0.5


def imaginary_part(frequency: jax.Array, loop: Loop) -> jax.Array:
    """Computes Im T, which is 0 where L is real."""
    return transfer(frequency, loop).imag


def excess(frequency: jax.Array, loop: Loop) -> jax.Array:
    """Computes |T - 1/2|^2 - 1/4 without cancellation."""
    T = transfer(frequency, loop)
    return T.real * T.real + T.imag * T.imag - T.real


def excess_slope(frequency: jax.Array, loop: Loop) -> jax.Array:
    """Computes the derivative of `excess` with respect to frequency."""
    return _with_slope(excess, frequency, loop)[1]


def _with_slope(function: _OfFrequency, frequency: jax.Array, loop: Loop) -> tuple[jax.Array, jax.Array]:
    """Returns value and derivative with respect to frequency."""
    return jax.jvp(lambda w: function(w, loop), (frequency,), (jnp.ones_like(frequency),))


def gain_candidates(loop: Loop) -> jax.Array:
    """Returns candidates for zeros of T(s) + T(-s) - 1 on the imaginary axis."""
    feedback = jnp.outer(loop.B, loop.K)
    plant = loop.F + feedback
    return _on_axis(jnp.linalg.eigvals(jnp.block([[plant, -feedback], [feedback, -plant]])))


def phase_candidates(loop: Loop, scale: jax.Array) -> jax.Array:
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


def level_candidates(loop: Loop, level: jax.Array) -> jax.Array:
    """Returns candidates for axis zeros of T(s) T(-s) - (T(s) + T(-s)) / 2 - level, where `excess` is the level."""
    feedback = jnp.outer(loop.B, loop.K) / level
    half, lower = 0.5 * feedback, (level + 0.25) * feedback
    return _on_axis(jnp.linalg.eigvals(jnp.block([[loop.F - half, -feedback], [lower, half - loop.F]])))


def _on_axis(zeros: jax.Array) -> jax.Array:
    """Returns candidate frequencies (n,), ascending and padded with 0, from zeros (2n,) in conjugate pairs.

    No zero is rejected for its real part, which is subject to rounding: a superfluous candidate does no harm.
    """
    usable = jnp.isfinite(zeros.imag) & (zeros.imag > 0.0)
    return jnp.sort(where(usable, zeros.imag, 0.0))[zeros.shape[0] // 2 :]


def _largest(vector: jax.Array) -> jax.Array:
    largest = jnp.max(jnp.abs(vector))
    return where(largest > 0.0, largest, 1.0)


def epsilon(array: jax.Array) -> float:
    return float(np.finfo(array.dtype).eps)


def roots_near(condition: _OfFrequency, guesses: jax.Array, loop: Loop, scale: jax.Array) -> Crossovers:
    """Returns the root of `condition` near each guess, with its derivative with respect to the loop."""
    return jax.vmap(partial(root_near, condition), in_axes=(0, None, None))(guesses, loop, scale)


def root_near(condition: _OfFrequency, guess: jax.Array, loop: Loop, scale: jax.Array) -> Crossovers:
    """Returns the positive root of `condition` near a guess, marked valid where Newton's steps have become short.

    Without a root on the axis they do not: for a zero at a distance d from the axis they stay longer than d.
    """
    fixed = lax.stop_gradient(loop)  # Newton only searches: `tied` gives the root the derivative of its equation

    def newton(_: Any, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        frequency, _ = carry
        value, slope = _with_slope(condition, frequency, fixed)
        step = where(value == 0.0, 0.0, value / slope)
        return jnp.abs(frequency - jnp.clip(step, -frequency, frequency)), jnp.abs(step)

    start = where(guess > 0.0, guess, scale)
    frequency, step = lax.fori_loop(0, 5, newton, (start, start))
    valid = (guess > 0.0) & (frequency > 0.0) & (step <= epsilon(guess) ** (1 / 3) * frequency)
    frequency = tied(condition, where(valid, frequency, scale), loop)
    return Crossovers(where(valid, frequency, scale), valid)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def tied(condition: _OfFrequency, frequency: jax.Array, loop: Loop) -> jax.Array:
    """Returns `frequency`, a root of `condition`, with its derivative with respect to the loop."""
    return frequency


@tied.defjvp
def _tied_jvp(
    condition: _OfFrequency, primals: tuple[jax.Array, Loop], tangents: tuple[jax.Array, Loop]
) -> tuple[jax.Array, jax.Array]:
    frequency, loop = primals
    frequency = tied(condition, frequency, loop)
    _, slope = _with_slope(condition, frequency, loop)
    _, change = jax.jvp(lambda moved: condition(frequency, moved), (loop,), (tangents[1],))
    return frequency, -change / where(slope == 0.0, jnp.inf, slope)
