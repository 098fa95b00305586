"""What a tuning was asked for, and what it found."""

import dataclasses
from typing import Any

import numpy as np

from cpjax import io
from cpjax.controllers import Hybrid
from cpjax.numeric.statistics import wilson_interval
from cpjax.plant import CartPole
from cpjax.tune.config import TuningConfig
from cpjax.tune.parameters import FreeParameters

Numbers = np.ndarray[Any, Any]


@dataclasses.dataclass(frozen=True)
class Tuning:
    """What `tune` found.

    Attributes:
      controller: the best one.
      vector: its free parameters, unconstrained (d,).
      labels: their names.
      physical: and themselves, in SI units.
      score: by which it was chosen: mean settling time [s], a failure counting three horizons; weighed as in the goal,
        with its effort and jerkiness.
      success_rate: on the starts of the last comparison.
      settling_time: mean over the successes among them [s].
      history: one record per validation.
      value_steps: RK4 steps simulated for values alone.
      gradient_steps: and with a gradient, iterations spent on crossings included.
      seconds: of this process, compilation included.
    """

    controller: Hybrid
    vector: Numbers
    labels: tuple[str, ...]
    physical: Numbers
    score: float
    success_rate: float
    settling_time: float
    history: list[dict[str, Any]]
    value_steps: int
    gradient_steps: int
    seconds: float


def request(plant: CartPole, free: FreeParameters, plan: TuningConfig) -> dict[str, Any]:
    """What a tuning depends on, as plain values: two of the same request end in the same bits on one machine."""
    return {
        "versions": io.versions(),
        "plan": plan.table(),
        "plant": io.encode(plant),
        "start_from": io.encode(free.controller),
        "free": [slot._asdict() for slot in free.slots],
    }


def document(tuning: Tuning, plant: CartPole, free: FreeParameters, plan: TuningConfig) -> dict[str, Any]:
    """The result for programs; its controller is also a file of its own."""
    fields = {f.name: getattr(tuning, f.name) for f in dataclasses.fields(tuning) if f.name != "controller"}
    low, high = wilson_interval(round(tuning.success_rate * plan.final), plan.final)
    return {
        "what": "a tuning by gradients through swing-ups",
        **request(plant, free, plan),
        "controller": io.encode(tuning.controller),
        "success_interval": [low, high],
        **fields,
    }
