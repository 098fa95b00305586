"""Fits of plants to printed gains: least squares over chosen parameters, from many random initial points at once.

The Levenberg-Marquardt method, on derivatives through `linearize`, `lqr` and `place_polynomial`. Residuals are in units
of the last printed digit.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from cpjax.numeric.selection import where
from cpjax.numeric.small_matrices import linear_solve
from cpjax.paper.printed_gains import PrintedGain
from cpjax.plant import CartPole, Motor, parameter, parameters_of, with_parameters
from cpjax.pytree import cast, numbers

PARAMETERS = tuple(name for name, rule in numbers(CartPole, Motor).items() if rule.linear and rule.scales)
"""Names of the parameters of a plant that its linear model may depend on and whose range holds every positive number: a
fit multiplies them by any positive factor."""

EXPLAINED = 1.0
"""Worst residual, in units of the last digit, up to which gains count as explained: two roundings leave up to 1.0."""

_STEPS = 40
_BATCH = 512  # batch size: fits that run at once
_START_FACTOR = 3.0
Progress: TypeAlias = Callable[[int, int, str], None]


@dataclasses.dataclass(frozen=True)
class Fit:
    """Best fit of the gains by changes of some of a plant's parameters.

    Attributes:
      parameters: names of those that may change.
      values: their fitted values [SI].
      residuals: computed minus printed gain, in units of the last digit, all gains in a row.
      reached: share of the random initial points whose fit ends at a cost within 1 % or 0.01 of the best.
    """

    parameters: tuple[str, ...]
    values: tuple[float, ...]
    residuals: tuple[float, ...]
    reached: float

    @property
    def worst(self) -> float:
        """Largest magnitude of a residual, in units of the last digit."""
        return max(abs(r) for r in self.residuals)

    @property
    def explains(self) -> bool:
        """Whether every residual is at most `EXPLAINED`."""
        return self.worst <= EXPLAINED


def scale_of(plant: CartPole, name: str) -> float:
    """Returns the parameter's value [SI]; if it is zero, its typical size on this plant."""
    return float(parameter(plant, name)) or parameters_of(plant)[name].size(plant) or 1.0


def _residuals(prints: Sequence[PrintedGain], plant: CartPole) -> Float[Array, " residuals"]:
    gains = jnp.concatenate([p.computed(plant) for p in prints])
    printed = jnp.asarray([k for p in prints for k in p.gain], dtype=gains.dtype)
    return (gains - printed) / jnp.asarray([u for p in prints for u in p.unit], dtype=gains.dtype)


def _with_derivatives(
    prints: tuple[PrintedGain, ...],
    plant: CartPole,
    values: Callable[[Float[Array, " parameters"]], Mapping[str, Float[Array, ""]]],
    x: Float[Array, " parameters"],
) -> tuple[Float[Array, " residuals"], Float[Array, "residuals parameters"]]:
    """Returns residuals and their derivatives by x, on the plant changed to `values(x)`."""

    def twice(x: Float[Array, " parameters"]) -> tuple[Float[Array, " residuals"], Float[Array, " residuals"]]:
        r = _residuals(prints, with_parameters(plant, values(x)))
        return r, r

    J, r = jax.jacfwd(twice, has_aux=True)(x)
    return r, J


# Compiled for all parameters, whichever may change: one program serves every audit of the same number of gains.


def linearised(
    prints: tuple[PrintedGain, ...], plant: CartPole
) -> tuple[Float[np.ndarray, " residuals"], Float[np.ndarray, "residuals parameters"]]:
    """Returns the residuals on `plant`, four for each gain, and their derivatives by all `PARAMETERS`."""
    r, J = _compiled_linearisation(prints, *_numbers(plant))
    return np.asarray(r), np.asarray(J)


@jax.jit
def _compiled_linearisation(
    prints: tuple[PrintedGain, ...], plant: CartPole, numbers: Float[Array, " parameters"]
) -> tuple[Float[Array, " residuals"], Float[Array, "residuals parameters"]]:
    return _with_derivatives(prints, plant, lambda x: dict(zip(PARAMETERS, x, strict=True)), numbers)


def _numbers(plant: CartPole) -> tuple[CartPole, Float[Array, " parameters"]]:
    """Returns the plant with arrays for numbers, and the values of all `PARAMETERS`, of one dtype."""
    numbers = jnp.asarray([float(parameter(plant, name)) for name in PARAMETERS])
    return cast(plant, numbers.dtype), numbers


def random_starts(
    sets: Sequence[tuple[str, ...]], most: int, count: int, seed: int
) -> Float[np.ndarray, "sets count most"]:
    """Draws logarithms of factors, from 1/3 to 3; those beyond a set's size are unused.

    Args:
      sets: names of the parameters of each fit.
      most: size of the largest set.
      count: initial points of each set.
      seed: of the random numbers.
    """
    generator, spread = np.random.default_rng(seed), math.log(_START_FACTOR)
    return generator.uniform(-spread, spread, (len(sets), count, most))


def fit_all(
    prints: tuple[PrintedGain, ...],
    plant: CartPole,
    sets: Sequence[tuple[str, ...]],
    starts: Float[np.ndarray, "sets count most"],
    progress: Progress | None,
) -> list[Fit]:
    """Fits each set of parameters from all its initial points, and returns the best fit of each.

    Args:
      prints: the gains.
      plant: the plant, which keeps the parameters that are not in a set.
      sets: names of the parameters of each fit, all in `PARAMETERS`.
      starts: logarithms of factors, see `random_starts`.
      progress: called with the sets done, their number, and the current work in words.
    """
    count, most = starts.shape[1:]
    # One program for sets of any size: an index beyond the last parameter is padding of a smaller set.
    padded = [[*map(PARAMETERS.index, names), *[len(PARAMETERS)] * (most - len(names))] for names in sets]
    chosen, x = np.repeat(padded, count, axis=0), starts.reshape(-1, most)
    base = jnp.asarray([scale_of(plant, name) for name in PARAMETERS])
    size = min(_BATCH, len(x))
    ends = []
    for first in range(0, len(x), size):
        if progress is not None:
            text = f"sets of up to {most} parameters, {count} initial states each"
            progress(first // count, len(sets), text)
        now = np.arange(first, first + size) % len(x)  # surplus elements of the last batch are dropped below
        ends.append(_fitted(prints, *_numbers(plant), base, chosen[now], jnp.asarray(x[now])))
    found, rest = (np.concatenate(a)[: len(x)].reshape(len(sets), count, -1) for a in zip(*ends, strict=True))
    cost = np.sum(rest**2, axis=-1)
    fits = []
    for row, names in enumerate(sets):
        best = int(np.argmin(cost[row]))
        lowest = cost[row, best]
        agree = cost[row] <= lowest + max(0.01 * lowest, 0.01)
        fits.append(
            Fit(
                names,
                tuple(found[row, best, : len(names)].tolist()),
                tuple(rest[row, best].tolist()),
                float(np.mean(agree & np.isfinite(cost[row]))),
            )
        )
    return fits


@jax.jit
def _fitted(
    prints: tuple[PrintedGain, ...],
    plant: CartPole,
    own: Float[Array, " parameters"],
    base: Float[Array, " parameters"],
    chosen: Int[Array, "fits most"],
    starts: Float[Array, "fits most"],
) -> tuple[Float[Array, "fits most"], Float[Array, "fits residuals"]]:
    """Returns the fitted values of the chosen parameters and the residuals of all fits.

    Args:
      own: values of all parameters on the plant, used for those not chosen.
      base: values that the exponentials of `starts` multiply.
      chosen: indices into `PARAMETERS`, or their number for none.
      starts: initial points, logarithms of factors.
    """
    own, base = jnp.append(own, 1.0), jnp.append(base, 1.0)

    def one(
        chosen: Int[Array, " most"], x: Float[Array, " most"]
    ) -> tuple[Float[Array, " most"], Float[Array, " residuals"]]:
        def values(x: Float[Array, " most"]) -> dict[str, Float[Array, ""]]:
            numbers = own.at[chosen].set(base[chosen] * jnp.exp(x))
            return dict(zip(PARAMETERS, numbers[:-1], strict=True))

        end, rest = least_squares(lambda x: _with_derivatives(prints, plant, values, x), x, 4 * len(prints))
        return base[chosen] * jnp.exp(end), rest

    return jax.vmap(one)(chosen, starts)


def least_squares(
    residuals: Callable[
        [Float[Array, " parameters"]], tuple[Float[Array, " residuals"], Float[Array, "residuals parameters"]]
    ],
    x: Float[Array, " parameters"],
    count: int,
) -> tuple[Float[Array, " parameters"], Float[Array, " residuals"]]:
    """Minimises the residuals' sum of squares by the Levenberg-Marquardt method.

    Args:
      residuals: maps x to residuals and their derivatives.
      x: initial point.
      count: number of residuals.

    Returns:
      The best point found, and the residuals there, which are infinite if they are not finite at `x`.
    """

    def step(carry: tuple[Any, ...], _: None) -> tuple[Any, None]:
        trial, best, damping = carry
        r, J = residuals(trial)
        tried = (jnp.sum(r * r), trial, r, J)
        better = tried[0] < best[0]  # False for NaN
        best = jax.tree.map(lambda new, old: where(better, new, old), tried, best)
        damping = jnp.clip(where(better, damping / 5.0, damping * 4.0), 1e-12, 1e8)
        _, x, r, J = best
        H = J.T @ J
        scale = jnp.diagonal(H)
        damped = H + damping * jnp.diag(where(scale > 0.0, scale, 1.0))
        # A change by more than a factor of e in one step would leave the region where the linearisation holds.
        return (x - jnp.clip(linear_solve(damped, (J.T @ r)[:, None])[:, 0], -1.0, 1.0), best, damping), None

    unknown = jnp.full((count,), jnp.inf, dtype=x.dtype)
    nowhere = (unknown[0], x, unknown, jnp.zeros((count, x.shape[0]), dtype=x.dtype))
    (_, (_, x, rest, _), _), _ = lax.scan(step, (x, nowhere, jnp.asarray(5e-2, dtype=x.dtype)), length=_STEPS + 1)
    return x, rest
