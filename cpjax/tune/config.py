"""Configuration of a tuning: budgets, batches and the curriculum."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

from jaxtyping import Array, Float

from cpjax.errors import InputError
from cpjax.fields import choice, config, count, number
from cpjax.plant.initial_states import START_SETS
from cpjax.sim.settings import check_whole_steps
from cpjax.tune.objective import Aggregate, Goal, soft_maximum, success_weighted, tail_mean

_AGGREGATES: Mapping[str, Callable[["TuningConfig"], Aggregate]] = {
    "tail": lambda plan: tail_mean(plan.tail),
    "soft-maximum": lambda plan: soft_maximum(plan.temperature),
    "success-weighted": lambda plan: success_weighted(plan.threshold, plan.temperature),
}
AGGREGATES = tuple(_AGGREGATES)
"""Values that `TuningConfig.aggregate` may have."""


@config
class TuningConfig:
    """Configuration of a tuning: screen candidates, improve the best by gradients, keep the best in validation.

    No seed below 2**32 draws the same initial states by `cpjax.sample_starts`.
    """

    starts: str = choice("set from which initial states are drawn", START_SETS, default="hanging")
    seed: int = count("of all random numbers", default=1, at_most=math.inf)
    goal: Goal = dataclasses.field(default_factory=Goal)
    """The weights of the objective."""
    candidates: int = count("random controllers beside the given one; 0 tunes the given one alone", default=4095)
    screening: int = count(
        "initial states of the first comparison of candidates, by values alone; the better quarter is compared again "
        "on four times as many, and so on",
        default=2,
        at_least=1,
    )
    restarts: int = count("best candidates that are tuned, the given controller among them", default=8, at_least=1)
    batch: int = count("initial states of each step", default=16, at_least=1)
    resample: int = count("steps between draws of a new batch; 0 keeps the first batch", default=1)
    steps: int = count("steps of the optimiser", default=66)
    explore: float = number(
        "1",
        "standard deviation of the noise on the unconstrained parameters when, after each validation, the worse half "
        "of the restarts is restarted from the better half; falls linearly to zero. 0 restarts none",
        default=0.2,
        at_least=0.0,
    )
    learning_rate: float = number(
        "1",
        "initial learning rate of Adam; it falls to a twentieth along a cosine",
        default=0.05,
        above=0.0,
        at_most=10.0,
    )
    duration: float = number("s", "duration of the tuning's rollouts", default=3.0, above=0.0)
    dt: float = number("s", "their step", default=0.02, above=0.0)
    spare_rate: float = number(
        "1/s",
        "additional steps per second, for located crossings; a run that needs more is stopped",
        default=20.0,
        at_least=0.0,
    )
    first_width: float = number("rad and m", "initial width of the target", default=0.2, above=0.0)
    last_width: float = number(
        "rad and m",
        "width of the target after the first 60 percent of the steps, reached geometrically",
        default=0.03,
        above=0.0,
    )
    aggregate: str = choice("how a batch's values become one number", AGGREGATES, default="tail")
    tail: float = number(
        "1", "share of the worst initial states that the mean is taken over", default=1.0, above=0.0, at_most=1.0
    )
    temperature: float = number("s", "of a soft maximum or a success-weighted mean", default=0.3, above=0.0)
    threshold: float = number("s", "of a success-weighted mean", default=3.0, above=0.0)
    clip: float = number(
        "1",
        "each initial state's gradient is norm-clipped to this many times the batch's median norm",
        default=2.0,
        above=0.0,
        infinite=True,
    )
    validate_every: int = count(
        "steps between validations; the checkpoint is written after each", default=6, at_least=1
    )
    validation: int = count("initial states of a validation, the same each time", default=256, at_least=1)
    patience: int = count("validations without improvement after which a tuning ends; 0 for never", default=0)
    finalists: int = count(
        "restarts that, after a comparison of all, are compared once more with final_horizon and final_dt",
        default=2,
        at_least=1,
    )
    final: int = count("initial states of each of these two comparisons", default=1024, at_least=1)
    final_horizon: float = number("s", "duration of the last comparison's runs", default=10.0, above=0.0)
    final_dt: float = number("s", "their step and control period", default=0.002, above=0.0)
    horizon: float = number("s", "duration of the runs of all other comparisons", default=5.0, above=0.0)
    horizon_dt: float = number("s", "their step and control period", default=0.008, above=0.0)
    pole_limit: float = number(
        "1/s",
        "bound on the magnitude of the fastest pole of the linear closed loop",
        default=250.0,
        above=0.0,
        infinite=True,
    )
    plant_spread: float = number(
        "1",
        "every uncertain parameter of the plant is drawn within this share of its value, for each initial state; the "
        "law's model is not",
        default=0.0,
        at_least=0.0,
        below=1.0,
    )

    def __post_init__(self) -> None:
        if not isinstance(self.goal, Goal):
            raise InputError("goal", self.goal, "a cpjax.tune.objective.Goal")
        check_whole_steps(self, ("duration", "dt"), ("horizon", "horizon_dt"), ("final_horizon", "final_dt"))
        if self.restarts > self.candidates + 1:
            raise InputError("restarts", self.restarts, f"at most candidates + 1, {self.candidates + 1}")

    def aggregated(self, values: Float[Array, " starts"]) -> Float[Array, ""]:
        """Returns one number for the objective's values of a batch."""
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


Plan = TuningConfig
"""The name until version 0.1."""
