"""Objectives of a tuning: metrics of a rollout, their weighted sum, and aggregates over many initial states.

Every term is smooth in the trajectory or has kinks at most, and is bounded or grows slowly, so that one bad initial
state does not dominate the others.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cpjax.errors import InputError
from cpjax.fields import renamed
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.pytree import Scalar, number, part, pytree
from cpjax.sim.metrics import Integral, Metric, MetricState, Sample, TimeOutside, finalize


class _Integral:
    """Metric that integrates `rate(state, voltage)` over time, by the trapezoidal rule."""

    def rate(self, state: State, voltage: Float[Array, ""]) -> Float[Array, ""]:
        raise NotImplementedError

    def init(self, sample: Sample) -> Integral:
        return jnp.zeros_like(sample.time), self.rate(sample.state, sample.voltage)

    def update(self, state: Integral, sample: Sample) -> Integral:
        total, before = state
        until = self.rate(sample.state, sample.voltage_before)
        return total + 0.5 * sample.elapsed * (before + until), self.rate(sample.state, sample.voltage)

    def finalize(self, state: Integral, last: Sample) -> Float[Array, ""]:
        return state[0]


@pytree
class Effort(_Integral):
    """Metric: the integral of u^2 dt [V^2 s]."""

    def rate(self, state: State, voltage: Float[Array, ""]) -> Float[Array, ""]:
        return voltage * voltage


@pytree
class TrackExcess(_Integral):
    """Soft track limit: time spent near or beyond it, weighted from 0 to 1 by the excess [s].

    The integral of 1 - exp(-(max(|x| - limit + margin, 0) / margin)^2 / 2).
    """

    limit: Scalar = number("m", "the track: |x| within", above=0.0)
    margin: Scalar = number("m", "where the cost begins before the limit, and over which it rises", above=0.0)

    def rate(self, state: State, voltage: Float[Array, ""]) -> Float[Array, ""]:
        over = jnp.maximum(jnp.abs(state.x) - self.limit + self.margin, 0.0) / self.margin
        return 1.0 - jnp.exp(-0.5 * over * over)


@pytree
class EnergyError(_Integral):
    """Time spent with the wrong pendulum energy [s]: a cost with a nonzero gradient even where no catch is near.

    The integral of 1 - exp(-(E / width)^2 / 2), with E the pendulum's energy, zero upright at rest, in units of
    2 m g l, which lifts it from hanging to upright.
    """

    plant: CartPole = part("plant whose pendulum energy counts, a CartPole", "pendulum_energy")
    width: Scalar = number("1", "of the target", default=0.5, above=0.0)

    def rate(self, state: State, voltage: Float[Array, ""]) -> Float[Array, ""]:
        lift = 2.0 * self.plant.pole_mass * self.plant.gravity * self.plant.pole_length
        error = self.plant.pendulum_energy(state) / (lift * self.width)
        return 1.0 - jnp.exp(-0.5 * error * error)


@pytree
class VoltageVariation:
    """Smoothed total variation of the applied voltage [V]: a change d counts sqrt(d^2 + rounding^2) - rounding."""

    rounding: Scalar = number("V", "changes far smaller than this count little", default=0.1, above=0.0)

    def init(self, sample: Sample) -> Float[Array, ""]:
        return jnp.zeros_like(sample.time)

    def update(self, state: Float[Array, ""], sample: Sample) -> Float[Array, ""]:
        moved = self._size(sample.voltage - sample.voltage_before)
        if sample.voltage_until is not None:
            moved = moved + self._size(sample.voltage_until - sample.voltage_since)
        return state + moved

    def finalize(self, state: Float[Array, ""], last: Sample) -> Float[Array, ""]:
        return state

    def _size(self, change: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.sqrt(change * change + self.rounding * self.rounding) - self.rounding


@pytree
class TerminalCost:
    """Deviation from upright at x = 0 when the run ends, between 0 and 1; the widths are those of `TimeOutside`."""

    angle_width: Scalar = number("rad", "of the target", default=0.2, above=0.0)
    position_width: Scalar = number("m", "of the target", default=0.2, above=0.0)

    def init(self, sample: Sample) -> Float[Array, ""]:
        return self._outside(sample)

    def update(self, state: Float[Array, ""], sample: Sample) -> Float[Array, ""]:
        return self._outside(sample)

    def finalize(self, state: Float[Array, ""], last: Sample) -> Float[Array, ""]:
        return state

    def _outside(self, sample: Sample) -> Float[Array, ""]:
        return TimeOutside(self.angle_width, self.position_width)._outside(sample)


@pytree
class RemainingTime:
    """Time lost when a run is stopped early [s]: a cost, so that stopping is no advantage."""

    duration: Scalar = number("s", "of the whole run", above=0.0)

    def init(self, sample: Sample) -> Float[Array, ""]:
        return jnp.zeros_like(sample.time)

    def update(self, state: Float[Array, ""], sample: Sample) -> Float[Array, ""]:
        return state + sample.elapsed

    def finalize(self, state: Float[Array, ""], last: Sample) -> Float[Array, ""]:
        return jnp.asarray(self.duration, state.dtype) - state


@pytree
class Travel:
    """Cart travel max |x| [m]."""

    def init(self, sample: Sample) -> Float[Array, ""]:
        return jnp.zeros_like(sample.time)

    def update(self, state: Float[Array, ""], sample: Sample) -> Float[Array, ""]:
        return jnp.maximum(state, jnp.abs(sample.state.x))

    def finalize(self, state: Float[Array, ""], last: Sample) -> Float[Array, ""]:
        return state


class _Several:
    """Several metrics computed together."""

    terms: tuple[Metric, ...]

    def init(self, sample: Sample) -> tuple[MetricState, ...]:
        return tuple(term.init(sample) for term in self.terms)

    def update(self, state: tuple[MetricState, ...], sample: Sample) -> tuple[MetricState, ...]:
        return tuple(term.update(m, sample) for term, m in zip(self.terms, state, strict=True))

    def _results(self, state: tuple[MetricState, ...], last: Sample) -> list[Any]:
        return [finalize(term, m, last) for term, m in zip(self.terms, state, strict=True)]


@pytree
class WeightedSum(_Several):
    """Weighted sum of the results of several metrics."""

    terms: tuple[Metric, ...]
    weights: tuple[Scalar, ...]

    def finalize(self, state: tuple[MetricState, ...], last: Sample) -> Float[Array, ""]:
        total = jnp.zeros_like(last.time)
        for weight, result in zip(self.weights, self._results(state, last), strict=True):
            total = total + jnp.asarray(weight, dtype=total.dtype) * result
        return total


@pytree
class Lagrangian(_Several):
    """Lagrangian of the time outside the target under bounds on the mean costs [s]; and the costs themselves.

    The Lagrangian is time + remaining (1 + stop_penalty) + sum(multiplier cost), with the time `remaining`
    when the run is stopped early.
    """

    terms: tuple[Metric, ...]
    """Metrics: the time outside the target, the costs, and the remaining time of a stopped run."""
    multipliers: tuple[Scalar, ...]
    """Multiplier of each cost [s per unit of the cost]."""
    stop_penalty: Scalar
    """Extra weight of each second lost when a run stops early [1]."""

    def finalize(
        self, state: tuple[MetricState, ...], last: Sample
    ) -> tuple[Float[Array, ""], tuple[Float[Array, ""], ...]]:
        time, *costs, undone = self._results(state, last)
        total = time + undone * (1.0 + self.stop_penalty)
        for multiplier, cost in zip(self.multipliers, costs, strict=True):
            total = total + multiplier * cost
        return total, tuple(costs)


@renamed(jerkiness="voltage_variation")
@pytree
class Goal:
    """Weights of the objective, whose unit is the second. Terms of weight 0 are not computed."""

    time: Scalar = number("1", "of the time outside the target", default=1.0, at_least=0.0)
    effort: Scalar = number("s/(V^2 s)", "of the integral of u^2", default=0.0, at_least=0.0)
    track: Scalar = number("1", "of the time beyond the track's limit", default=0.0, at_least=0.0)
    track_limit: Scalar = number("m", "of the track", default=math.inf, above=0.0, infinite=True)
    voltage_variation: Scalar = number("s/V", "of the voltage's total variation", default=0.0, at_least=0.0)
    energy: Scalar = number("1", "of the time with the wrong energy", default=0.0, at_least=0.0)
    terminal: Scalar = number("s", "of the distance at the end", default=0.0, at_least=0.0)

    def __post_init__(self) -> None:
        if (float(self.track) > 0.0) != math.isfinite(float(self.track_limit)):
            raise InputError("Goal.track", self.track, "above 0 if and only if track_limit is finite")
        if not any(float(getattr(self, name)) > 0.0 for name in WEIGHTS):
            raise InputError("Goal", self, "with at least one weight above 0")

    def metric(self, plant: CartPole, width: Scalar, duration: float) -> Metric:
        """Returns the metric that computes the objective of one run [s].

        The time that remains when a flag stops a run counts as outside the target, beyond the track, at the wrong
        energy and, if the voltage limit is finite, at full voltage.

        Args:
          plant: the pendulum whose energy counts, and the voltage limit.
          width: of the target [rad and m].
          duration: of the whole run [s].
        """
        limit, supply = float(self.track_limit), float(plant.motor.voltage_limit)
        makers: Mapping[str, Callable[[], Metric]] = {
            "time": lambda: TimeOutside(width, width),
            "effort": Effort,
            "track": lambda: TrackExcess(limit, 0.1 * limit),
            "voltage_variation": VoltageVariation,
            "energy": lambda: EnergyError(plant),
            "terminal": lambda: TerminalCost(width, width),
        }
        chosen = [name for name in WEIGHTS if float(getattr(self, name)) > 0.0]
        worst = float(self.time) + float(self.track) + float(self.energy)
        worst += float(self.effort) * supply * supply if math.isfinite(supply) else 0.0
        terms = (*(makers[name]() for name in chosen), RemainingTime(duration))
        return WeightedSum(terms, (*(float(getattr(self, name)) for name in chosen), worst))


WEIGHTS = ("time", "effort", "track", "voltage_variation", "energy", "terminal")
"""Names of the weights of a `Goal`."""


Aggregate: TypeAlias = Callable[[Float[Array, " starts"]], Float[Array, ""]]
"""Reduces the values of all initial states to one number; its derivative is the weight of each gradient."""


def tail_mean(share: float) -> Aggregate:
    """Returns the aggregate that averages the worst values: conditional value at risk (Rockafellar and Uryasev, 2000).

    Args:
      share: of the initial states; 1 for all [1].

    Raises:
      InputError: a share that is not above 0 and at most 1.
    """
    _check_share("share", share)

    def worst(values: Float[Array, " starts"]) -> Float[Array, ""]:
        count = max(1, round(share * values.shape[0]))
        return jnp.mean(jax.lax.top_k(values, count)[0])

    return worst


def soft_maximum(temperature: float) -> Aggregate:
    """Returns the aggregate T log mean exp(value / T): the mean for a large T, the maximum for a small one.

    Args:
      temperature: T, in the unit of the values [s].

    Raises:
      InputError: a temperature that is not finite and above 0.
    """
    if isinstance(temperature, (bool, str)) or not 0.0 < temperature < math.inf:
        raise InputError("temperature", temperature, "a finite number above 0")

    def smooth(values: Float[Array, " starts"]) -> Float[Array, ""]:
        log_count = jnp.log(jnp.asarray(values.shape[0], dtype=values.dtype))
        return temperature * (jax.nn.logsumexp(values / temperature) - log_count)

    return smooth


def success_weighted(threshold: float, temperature: float) -> Aggregate:
    """Returns the aggregate that is the mean weighted by 1 / (1 + exp((value - threshold) / temperature)).

    The weights are differentiated too: an initial state counts less the farther its value is above the threshold.

    Args:
      threshold: value at which the weight is 1/2 [s].
      temperature: difference of values over which the weight falls [s].

    Raises:
      InputError: a temperature that is not finite and above 0.
    """
    if isinstance(temperature, (bool, str)) or not 0.0 < temperature < math.inf:
        raise InputError("temperature", temperature, "a finite number above 0")

    def weighed(values: Float[Array, " starts"]) -> Float[Array, ""]:
        weights = jax.nn.sigmoid((threshold - values) / temperature)
        return jnp.sum(weights * values) / jnp.sum(weights)

    return weighed


def _check_share(field: str, share: Any) -> None:
    if isinstance(share, (bool, str)) or not 0.0 < share <= 1.0:
        raise InputError(field, share, "above 0 and at most 1")


Jerkiness, Unfinished, PricedTime = VoltageVariation, RemainingTime, Lagrangian
"""The names until version 0.1."""
