"""How trade-off fronts are traced: what is traded, and how much work goes into it."""

import dataclasses
from typing import TypeAlias

from cpjax.pytree import Number
from cpjax.tune.config import check_plan

COSTS = ("effort", "cart_travel", "voltage_variation")
"""Of `Metrics`, against the settling time."""

Lane: TypeAlias = tuple[float, str]
"""A supply [V] and a cost."""


@dataclasses.dataclass(frozen=True)
class FrontConfig:
    """How fronts are traced.

    Attributes:
      seed: of everything random. Starts are never those that a seed names for `cpjax.sample_starts`.
      bounds: tunings for each cost and supply, each with a bound on the cost, from `lowest` times the least cost among
        the candidates geometrically to the cost of the fastest; and one more without a bound.
      lowest: see there.
      fine: what a second costs that a stopped run leaves undone, beyond itself [1].
      price: of a bound's worth of a cost, at first [s].
      price_rate: the price grows by exp(price_rate (cost / bound - 1)) in each step.
      dearest: it stays between `price` / `dearest` and `price` times `dearest`.
      candidates: random controllers to begin with.
      screening: starts by which they are judged.
      steps: of the optimiser.
      batch: starts of a step.
      explore: noise on the unconstrained parameters of a tuning that goes on from another's, less and less to the end.
      learning_rate: Adam's.
      clip: a start's gradient is shortened to this many times the batch's median norm.
      duration: of the tunings' rollouts [s].
      dt: their step [s].
      spare_rate: steps beyond those in each second, for crossings [1/s].
      width: of the target [rad and m].
      variety: how many of the best candidates the tunings begin from, in turn.
      judge_every: steps after which all controllers are judged.
      exchange_from: the share of the steps after which each tuning then goes on from the best that was met.
      judging: starts by which they are.
      semifinal: starts by which the best of a front are compared once more: who was lucky with few is not with many.
      final: unseen starts that the points of a front are measured from.
      horizon: of all runs that judge [s].
      judging_dt: step and control period of screening and judging [s].
      final_dt: of semifinal and final [s].
      success: share of the starts that a point must settle from in both.
    """

    seed: int = 1
    bounds: int = 39
    lowest: float = 0.85
    fine: float = 10.0
    price: float = 3.0
    price_rate: float = 1.0
    dearest: float = 100.0
    candidates: int = 16384
    screening: int = 16
    steps: int = 100
    batch: int = 8
    learning_rate: float = 0.04
    clip: float = 2.0
    duration: float = 8.0
    dt: float = 0.02
    spare_rate: float = 20.0
    width: float = 0.05
    variety: int = 16
    judge_every: int = 4
    exchange_from: float = 0.4
    explore: float = 0.15
    judging: int = 96
    semifinal: int = 256
    final: int = 1024
    horizon: float = 20.0
    judging_dt: float = 0.004
    final_dt: float = 0.002
    success: float = 0.99

    def __post_init__(self) -> None:
        check_plan(self, _COUNTS, _NUMBERS, (("duration", "dt"), ("horizon", "judging_dt"), ("horizon", "final_dt")))


_COUNTS = {
    "seed": 0,
    "bounds": 1,
    "candidates": 1,
    "screening": 1,
    "steps": 0,
    "batch": 1,
    "variety": 1,
    "judge_every": 1,
    "judging": 1,
    "semifinal": 1,
    "final": 1,
}
_NUMBERS = {
    "lowest": Number("1", "", above=0.0, at_most=0.999),
    "fine": Number("1", "", above=0.0),
    "price": Number("s", "", above=0.0),
    "price_rate": Number("1", "", above=0.0),
    "dearest": Number("1", "", at_least=1.0),
    "exchange_from": Number("1", "", above=0.0, at_most=1.0),
    "explore": Number("1", "", at_least=0.0),
    "learning_rate": Number("1", "", above=0.0, at_most=10.0),
    "clip": Number("1", "", above=0.0),
    "duration": Number("s", "", above=0.0),
    "dt": Number("s", "", above=0.0),
    "spare_rate": Number("1/s", "", above=0.0),
    "width": Number("rad and m", "", above=0.0),
    "horizon": Number("s", "", above=0.0),
    "judging_dt": Number("s", "", above=0.0),
    "final_dt": Number("s", "", above=0.0),
    "success": Number("1", "", above=0.0, at_most=1.0),
}


FrontPlan = FrontConfig
"""The name until version 0.1."""
