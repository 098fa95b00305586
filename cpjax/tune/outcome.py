"""Request and result of a tuning."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from cpjax import files, io
from cpjax.controllers import Hybrid
from cpjax.numeric.statistics import wilson_interval
from cpjax.plant import CartPole
from cpjax.tune.config import TuningConfig
from cpjax.tune.parameters import FreeParameters


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Result of `tune`.

    Attributes:
      controller: the best controller.
      vector: its free parameters, unconstrained.
      labels: names of the free parameters.
      physical: values of the free parameters in SI units.
      score: mean over the last comparison's initial states of the settling time, with 30 horizons for a failure, of the
        effort and of the voltage variation, weighted as in the goal [s].
      success_rate: on the initial states of the last comparison.
      settling_time: mean over the successes among them [s]; NaN if there is none.
      history: one record per validation.
      value_steps: RK4 steps simulated for values alone.
      gradient_steps: RK4 steps simulated with a gradient, those for crossings included.
      seconds: wall time of the call that finished the tuning, compilation included [s].
    """

    controller: Hybrid
    vector: Float[np.ndarray, " parameters"]
    labels: tuple[str, ...]
    physical: Float[np.ndarray, " parameters"]
    score: float
    success_rate: float
    settling_time: float
    history: list[dict[str, Any]]
    value_steps: int
    gradient_steps: int
    seconds: float


def request(plant: CartPole, free: FreeParameters, plan: TuningConfig) -> dict[str, Any]:
    """Returns all that a tuning depends on, as plain values: equal requests give equal bits on one machine."""
    return {
        "versions": files.versions(),
        "plan": plan.table(),
        "plant": io.encode(plant),
        "start_from": io.encode(free.controller),
        "free": [slot._asdict() for slot in free.slots],
    }


def document(tuning: Tuning, plant: CartPole, free: FreeParameters, plan: TuningConfig) -> dict[str, Any]:
    """Returns request and result as plain values, for JSON; the success rate with its 95 % Wilson interval."""
    fields = {f.name: getattr(tuning, f.name) for f in dataclasses.fields(tuning) if f.name != "controller"}
    low, high = wilson_interval(round(tuning.success_rate * plan.final), plan.final)
    return {
        "what": "a tuning by gradients through swing-ups",
        **request(plant, free, plan),
        "controller": io.encode(tuning.controller),
        "success_interval": [low, high],
        **fields,
    }
