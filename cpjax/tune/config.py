"""Configuration of a tuning: budgets, batches and the curriculum."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from cpjax.errors import InputError
from cpjax.plant.initial_states import START_SETS
from cpjax.pytree import Number
from cpjax.sim.settings import check_settings
from cpjax.tune.objective import Aggregate, Goal, soft_maximum, success_weighted, tail_mean


@dataclasses.dataclass(frozen=True)
class TuningConfig:
    """Configuration of a tuning: screen candidates, improve the best by gradients, keep the best in validation.

    Attributes:
      starts: name of the set from which initial states are drawn.
      seed: of all random numbers. No seed below 2**32 draws the same initial states by `cpjax.sample_starts`.
      goal: the weights of the objective.
      candidates: random controllers beside the given one; 0 tunes the given one alone.
      screening: initial states of the first comparison of candidates, by values alone; the better quarter is compared
        again on four times as many, and so on.
      restarts: number of the best candidates that are tuned, the given controller among them.
      batch: initial states of each step.
      resample: steps between draws of a new batch; 0 keeps the first batch.
      steps: of the optimiser.
      explore: standard deviation of the noise on the unconstrained parameters when, after each validation, the worse
        half of the restarts is restarted from the better half; falls linearly to zero. 0 restarts none.
      learning_rate: initial learning rate of Adam; it falls to a twentieth along a cosine.
      duration: of the tuning's rollouts [s].
      dt: their step [s].
      spare_rate: additional steps per second, for located crossings [1/s]; a run that needs more is stopped.
      first_width: initial width of the target [rad and m].
      last_width: width of the target from 60 % of the steps on, reached geometrically [rad and m].
      aggregate: how a batch's values become one number: mean over a `tail`, soft maximum or success-weighted mean.
      tail: share of the worst initial states that the mean is taken over; 1 for all.
      temperature: of a soft maximum or a success-weighted mean [s].
      threshold: of a success-weighted mean [s].
      clip: each initial state's gradient is norm-clipped to this many times the batch's median norm.
      validate_every: steps between validations; the checkpoint is written after each.
      validation: initial states of a validation, the same each time.
      patience: validations without improvement after which a tuning ends; 0 for never.
      finalists: number of restarts that, after a comparison of all on `final` initial states, are compared once more
        with `final_horizon` and `final_dt`.
      final: initial states of each of these two comparisons.
      final_horizon: duration of the last comparison's runs [s].
      final_dt: their step and control period [s].
      horizon: duration of the runs of all other comparisons: screening, validation and the last but one [s].
      horizon_dt: their step and control period [s].
      pole_limit: bound on the magnitude of the fastest pole of the linear closed loop [1/s].
      plant_spread: every uncertain parameter of the plant is drawn within this share of its value, for each initial
        state; the law's model is not.
    """

    starts: str = "hanging"
    seed: int = 1
    goal: Goal = dataclasses.field(default_factory=Goal)
    candidates: int = 4095
    screening: int = 2
    restarts: int = 8
    batch: int = 16
    resample: int = 1
    steps: int = 66
    explore: float = 0.2
    learning_rate: float = 0.05
    duration: float = 3.0
    dt: float = 0.02
    spare_rate: float = 20.0
    first_width: float = 0.2
    last_width: float = 0.03
    aggregate: str = "tail"
    tail: float = 1.0
    temperature: float = 0.3
    threshold: float = 3.0
    clip: float = 2.0
    validate_every: int = 6
    validation: int = 256
    patience: int = 0
    finalists: int = 2
    final: int = 1024
    final_horizon: float = 10.0
    final_dt: float = 0.002
    horizon: float = 5.0
    horizon_dt: float = 0.008
    pole_limit: float = 250.0
    plant_spread: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.starts, str) or self.starts not in START_SETS:
            raise InputError("starts", self.starts, "one of " + ", ".join(START_SETS))
        if not isinstance(self.aggregate, str) or self.aggregate not in _AGGREGATES:
            raise InputError("aggregate", self.aggregate, "one of " + ", ".join(_AGGREGATES))
        if not isinstance(self.goal, Goal):
            raise InputError("goal", self.goal, "a cpjax.tune.objective.Goal")
        steps = (("duration", "dt"), ("horizon", "horizon_dt"), ("final_horizon", "final_dt"))
        check_plan(self, _COUNTS, _NUMBERS, steps)
        if self.restarts > self.candidates + 1:
            raise InputError("restarts", self.restarts, f"at most candidates + 1, {self.candidates + 1}")

    def aggregated(self, values: jax.Array) -> jax.Array:
        """Returns one number () for the objective's values of a batch (n,)."""
        return _AGGREGATES[self.aggregate](self)(values)

    @property
    def spare_steps(self) -> int:
        """Additional steps of a rollout with located switching, for crossings."""
        return math.ceil(self.spare_rate * self.duration)

    def width(self, step: int) -> float:
        """Returns the width of the target at a step of the optimiser [rad and m]."""
        done = min(1.0, step / max(1.0, 0.6 * self.steps))
        return float(self.first_width * (self.last_width / self.first_width) ** done)

    def table(self) -> dict[str, Any]:
        """Returns the configuration as plain values."""
        return dataclasses.asdict(self)


def check_plan(
    plan: Any, counts: Mapping[str, int], numbers: Mapping[str, Number], steps: Sequence[tuple[str, str]]
) -> None:
    """Checks the fields of a frozen config and normalises its real numbers in place.

    Args:
      plan: the config, a frozen dataclass.
      counts: names of integer fields, with the least value of each.
      numbers: names of real fields, with their rules.
      steps: pairs of a duration's name and the name of the step that must divide it.

    Raises:
      InputError: a field outside its range, named.
    """
    for name, least in counts.items():
        value = getattr(plan, name)
        most, also = (math.inf, "") if name == "seed" else (_MOST, f" and at most {_MOST}")
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise InputError(name, value, f"a whole number, at least {least}{also}")
    for name, rule in numbers.items():
        object.__setattr__(plan, name, rule.normalise(name, getattr(plan, name)))
    for whole, part in steps:
        try:
            check_settings(duration=getattr(plan, whole), dt=getattr(plan, part))
        except InputError as problem:
            field = part if problem.field == "dt" else whole
            raise InputError(field, getattr(plan, field), problem.allowed) from problem


_MOST = 10_000_000  # upper bound of every count but the seed: more would not fit in memory

_AGGREGATES: Mapping[str, Callable[[TuningConfig], Aggregate]] = {
    "tail": lambda plan: tail_mean(plan.tail),
    "soft-maximum": lambda plan: soft_maximum(plan.temperature),
    "success-weighted": lambda plan: success_weighted(plan.threshold, plan.temperature),
}
AGGREGATES = tuple(_AGGREGATES)
"""Values that `TuningConfig.aggregate` may have."""

_COUNTS = {
    "seed": 0,
    "candidates": 0,
    "screening": 1,
    "restarts": 1,
    "batch": 1,
    "resample": 0,
    "steps": 0,
    "validate_every": 1,
    "validation": 1,
    "patience": 0,
    "finalists": 1,
    "final": 1,
}
_NUMBERS = {
    "explore": Number("1", "", at_least=0.0),
    "learning_rate": Number("1", "", above=0.0, at_most=10.0),
    "first_width": Number("rad and m", "", above=0.0),
    "last_width": Number("rad and m", "", above=0.0),
    "tail": Number("1", "", above=0.0, at_most=1.0),
    "temperature": Number("s", "", above=0.0),
    "threshold": Number("s", "", above=0.0),
    "clip": Number("1", "", above=0.0, infinite=True),
    "pole_limit": Number("1/s", "", above=0.0, infinite=True),
    "plant_spread": Number("1", "", at_least=0.0, below=1.0),
    "duration": Number("s", "", above=0.0, at_most=math.inf),
    "dt": Number("s", "", above=0.0),
    "spare_rate": Number("1/s", "", at_least=0.0),
    "horizon": Number("s", "", above=0.0),
    "final_horizon": Number("s", "", above=0.0),
    "final_dt": Number("s", "", above=0.0),
    "horizon_dt": Number("s", "", above=0.0),
}


Plan = TuningConfig
"""The name until version 0.1."""
