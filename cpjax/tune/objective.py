"""What a tuning minimises: folds over a rollout, weighed and added, and what makes one number of many starts.

Every term is smooth in the trajectory, or has a kink at most, and is bounded or grows slowly, so that one bad start
cannot drown the others.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from cpjax.backend.extremes import fast_maximum
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.pytree import Scalar, number, part, pytree
from cpjax.sim.metrics import Fold, Sample, TimeOutside


class _Integral:
    """The integral over time of `rate(sample)`, by the trapezoidal rule."""

    def rate(self, state: State, voltage: jax.Array) -> jax.Array:
        raise NotImplementedError

    def init(self, sample: Sample) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros_like(sample.time), self.rate(sample.state, sample.voltage)

    def update(self, memory: tuple[jax.Array, jax.Array], sample: Sample) -> tuple[jax.Array, jax.Array]:
        total, before = memory
        until = self.rate(sample.state, sample.voltage_before)
        return total + 0.5 * sample.elapsed * (before + until), self.rate(sample.state, sample.voltage)

    def finish(self, memory: tuple[jax.Array, jax.Array], last: Sample) -> jax.Array:
        return memory[0]


@pytree
class Effort(_Integral):
    """The integral of u^2 dt [V^2 s]."""

    def rate(self, state: State, voltage: jax.Array) -> jax.Array:
        return voltage * voltage


@pytree
class TrackExcess(_Integral):
    """A soft track limit: the time spent beyond it, in proportion to how far, but at most 1 per second [s].

    The integral of 1 - exp(-(max(|x| - limit + margin, 0) / margin)^2 / 2).
    """

    limit: Scalar = number("m", "the track: |x| within", above=0.0)
    margin: Scalar = number("m", "where the cost begins before the limit, and over which it rises", above=0.0)

    def rate(self, state: State, voltage: jax.Array) -> jax.Array:
        over = jnp.maximum(jnp.abs(state.x) - self.limit + self.margin, 0.0) / self.margin
        return 1.0 - jnp.exp(-0.5 * over * over)


@pytree
class EnergyError(_Integral):
    """The time spent with the wrong energy [s]: a cost that has a slope where no catch is in sight.

    The integral of 1 - exp(-(E / width)^2 / 2), with E the pendulum's energy, zero upright at rest, in units of what it
    takes to lift it from hanging.
    """

    plant: CartPole = part("whose pendulum, a CartPole", "pendulum_energy")
    width: Scalar = number("1", "of the target", default=0.5, above=0.0)

    def rate(self, state: State, voltage: jax.Array) -> jax.Array:
        lift = 2.0 * self.plant.pole_mass * self.plant.gravity * self.plant.pole_length
        error = self.plant.pendulum_energy(state) / (lift * self.width)
        return 1.0 - jnp.exp(-0.5 * error * error)


@pytree
class VoltageVariation:
    """The total variation of the applied voltage, its corners rounded [V]: a step of `rounding` counts about a half."""

    rounding: Scalar = number("V", "changes far smaller than this count little", default=0.1, above=0.0)

    def init(self, sample: Sample) -> jax.Array:
        return jnp.zeros_like(sample.time)

    def update(self, memory: jax.Array, sample: Sample) -> jax.Array:
        moved = self._size(sample.voltage - sample.voltage_before)
        if sample.voltage_until is not None:
            moved = moved + self._size(sample.voltage_until - sample.voltage_since)
        return memory + moved

    def finish(self, memory: jax.Array, last: Sample) -> jax.Array:
        return memory

    def _size(self, change: jax.Array) -> jax.Array:
        return jnp.sqrt(change * change + self.rounding * self.rounding) - self.rounding


@pytree
class TerminalCost:
    """How far from upright in place the run ends, between 0 and 1; the widths are those of `TimeOutside`."""

    angle_width: Scalar = number("rad", "of the target", default=0.2, above=0.0)
    position_width: Scalar = number("m", "of the target", default=0.2, above=0.0)

    def init(self, sample: Sample) -> jax.Array:
        return self._outside(sample)

    def update(self, memory: jax.Array, sample: Sample) -> jax.Array:
        return self._outside(sample)

    def finish(self, memory: jax.Array, last: Sample) -> jax.Array:
        return memory

    def _outside(self, sample: Sample) -> jax.Array:
        return TimeOutside(self.angle_width, self.position_width)._outside(sample)


@pytree
class RemainingTime:
    """The time that a stopped run left undone [s]: counted as badly spent, so that being stopped gains nothing."""

    duration: Scalar = number("s", "of the whole run", above=0.0)

    def init(self, sample: Sample) -> jax.Array:
        return jnp.zeros_like(sample.time)

    def update(self, memory: jax.Array, sample: Sample) -> jax.Array:
        return memory + sample.elapsed

    def finish(self, memory: jax.Array, last: Sample) -> jax.Array:
        return jnp.asarray(self.duration, memory.dtype) - memory


@pytree
class Travel:
    """max |x| [m]."""

    def init(self, sample: Sample) -> jax.Array:
        return jnp.zeros_like(sample.time)

    def update(self, memory: jax.Array, sample: Sample) -> jax.Array:
        return fast_maximum(memory, jnp.abs(sample.state.x))

    def finish(self, memory: jax.Array, last: Sample) -> jax.Array:
        return memory


class _Several:
    """Several folds at once."""

    terms: tuple[Any, ...]

    def init(self, sample: Sample) -> tuple[Any, ...]:
        return tuple(term.init(sample) for term in self.terms)

    def update(self, memory: tuple[Any, ...], sample: Sample) -> tuple[Any, ...]:
        return tuple(term.update(m, sample) for term, m in zip(self.terms, memory, strict=True))

    def _results(self, memory: tuple[Any, ...], last: Sample) -> list[Any]:
        return [term.finish(m, last) for term, m in zip(self.terms, memory, strict=True)]


@pytree
class WeightedSum(_Several):
    """The sum of several folds' results, each times its weight."""

    terms: tuple[Any, ...]
    weights: tuple[Scalar, ...]

    def finish(self, memory: tuple[Any, ...], last: Sample) -> jax.Array:
        total = jnp.zeros_like(last.time)
        for weight, result in zip(self.weights, self._results(memory, last), strict=True):
            total = total + jnp.asarray(weight, dtype=total.dtype) * result
        return total


@pytree
class Lagrangian(_Several):
    """The time outside the target with every cost at its price [s]; and the costs themselves.

    That is time + unfinished (1 + fine) + sum(price cost): the Lagrangian of a time that is minimised under bounds on
    the costs' means, for multipliers `prices`.
    """

    terms: tuple[Any, ...]
    """The time, the costs, and the time that a stopped run left undone."""
    prices: tuple[Any, ...]
    """Of a unit of each cost [s]."""
    fine: Any

    def finish(self, memory: tuple[Any, ...], last: Sample) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        time, *costs, undone = self._results(memory, last)
        total = time + undone * (1.0 + self.fine)
        for price, cost in zip(self.prices, costs, strict=True):
            total = total + price * cost
        return total, tuple(costs)


@pytree
class Goal:
    """The weights of an objective. What has no weight is not computed; all together are to be read as seconds."""

    time: Scalar = number("1", "of the time outside the target", default=1.0, at_least=0.0)
    effort: Scalar = number("s/(V^2 s)", "of the integral of u^2", default=0.0, at_least=0.0)
    track: Scalar = number("1", "of the time beyond the track's limit", default=0.0, at_least=0.0)
    track_limit: Scalar = number("m", "of the track", default=math.inf, above=0.0, infinite=True)
    jerkiness: Scalar = number("s/V", "of the voltage's total variation", default=0.0, at_least=0.0)
    energy: Scalar = number("1", "of the time with the wrong energy", default=0.0, at_least=0.0)
    terminal: Scalar = number("s", "of the distance at the end", default=0.0, at_least=0.0)

    def __post_init__(self) -> None:
        if (float(self.track) > 0.0) != math.isfinite(float(self.track_limit)):
            raise InputError("Goal.track", self.track, "above 0 if and only if track_limit is finite")
        if not any(float(getattr(self, name)) > 0.0 for name in WEIGHTS):
            raise InputError("Goal", self, "with at least one weight above 0")

    def fold(self, plant: CartPole, width: Scalar, duration: float) -> Fold:
        """The objective of runs of this duration [s], with a target of this width [rad and m].

        Where a run is stopped, by a flag, the rest of it counts as outside the target, beyond the track, at the wrong
        energy and at full voltage.
        """
        limit, supply = float(self.track_limit), float(plant.motor.voltage_limit)
        makers: Mapping[str, Callable[[], Fold]] = {
            "time": lambda: TimeOutside(width, width),
            "effort": Effort,
            "track": lambda: TrackExcess(limit, 0.1 * limit),
            "jerkiness": VoltageVariation,
            "energy": lambda: EnergyError(plant),
            "terminal": lambda: TerminalCost(width, width),
        }
        chosen = [name for name in WEIGHTS if float(getattr(self, name)) > 0.0]
        worst = float(self.time) + float(self.track) + float(self.energy)
        worst += float(self.effort) * supply * supply if math.isfinite(supply) else 0.0
        terms = (*(makers[name]() for name in chosen), RemainingTime(duration))
        return WeightedSum(terms, (*(float(getattr(self, name)) for name in chosen), worst))


WEIGHTS = ("time", "effort", "track", "jerkiness", "energy", "terminal")
"""The weights that a `Goal` has."""


Aggregate: TypeAlias = Callable[[jax.Array], jax.Array]
"""One number of the values of many starts (n,). Its derivative says how much each start's gradient counts."""


def tail_mean(share: float) -> Aggregate:
    """The mean of the worst `share` of the starts (1: of all): the conditional value at risk (Rockafellar and Uryasev,
    2000).
    """
    _check_share("share", share)

    def worst(values: jax.Array) -> jax.Array:
        count = max(1, round(share * values.shape[0]))
        return jnp.mean(jax.lax.top_k(values, count)[0])

    return worst


def soft_maximum(temperature: float) -> Aggregate:
    """T log mean exp(value / T): the mean for a large temperature T, the maximum for a small one."""
    if isinstance(temperature, (bool, str)) or not 0.0 < temperature < math.inf:
        raise InputError("temperature", temperature, "a finite number above 0")

    def smooth(values: jax.Array) -> jax.Array:
        log_count = jnp.log(jnp.asarray(values.shape[0], dtype=values.dtype))
        return temperature * (jax.nn.logsumexp(values / temperature) - log_count)

    return smooth


def success_weighted(threshold: float, temperature: float) -> Aggregate:
    """The mean over the starts that are well, each weighed by 1 / (1 + exp((value - threshold) / temperature)).

    The weights are part of the value: a start that gets worse beyond the threshold counts less and less.
    """
    if isinstance(temperature, (bool, str)) or not 0.0 < temperature < math.inf:
        raise InputError("temperature", temperature, "a finite number above 0")

    def weighed(values: jax.Array) -> jax.Array:
        weights = jax.nn.sigmoid((threshold - values) / temperature)
        return jnp.sum(weights * values) / jnp.sum(weights)

    return weighed


def _check_share(field: str, share: Any) -> None:
    if isinstance(share, (bool, str)) or not 0.0 < share <= 1.0:
        raise InputError(field, share, "above 0 and at most 1")


Jerkiness, Unfinished, PricedTime = VoltageVariation, RemainingTime, Lagrangian
"""The names until version 0.1."""
