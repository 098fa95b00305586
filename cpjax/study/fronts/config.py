"""Configuration of the search for trade-off fronts: the costs, and how much work is done."""

import dataclasses
from typing import TypeAlias

from cpjax.pytree import Number
from cpjax.tune.config import check_plan

COSTS = ("effort", "cart_travel", "voltage_variation")
"""Fields of `Metrics` that are traded against the settling time."""

Lane: TypeAlias = tuple[float, str]
"""A supply [V] and a cost."""


@dataclasses.dataclass(frozen=True)
class FrontConfig:
    """Configuration of the search for trade-off fronts.

    Attributes:
      seed: of all random numbers. No seed below 2**32 draws the same initial states by `cpjax.sample_starts`.
      bounds: number of tunings for each cost and supply that have a bound on the cost, geometrically from `lowest`
        times the least cost among the candidates to the cost of the fastest; one more has no bound.
      lowest: factor of the lowest bound [1].
      fine: extra weight of each second lost when a run stops early [1].
      price: initial multiplier, of a cost in units of its bound [s].
      price_rate: in each step the multiplier grows by a factor exp(price_rate (cost / bound - 1)) [1].
      dearest: the multiplier stays between price / dearest and price * dearest [1].
      candidates: random controllers with which the search begins.
      screening: initial states on which candidates are screened.
      steps: of the optimiser.
      batch: initial states of a step.
      explore: standard deviation of the noise on the unconstrained parameters of a tuning that continues from another
        controller; falls linearly to zero.
      learning_rate: initial learning rate of Adam; it falls to a tenth along a cosine.
      clip: each initial state's gradient is norm-clipped to this many times the batch's median norm.
      duration: of the tunings' rollouts [s].
      dt: their step [s].
      spare_rate: additional steps per second, for located crossings [1/s].
      width: of the target [rad and m].
      variety: number of the best candidates from which the tunings begin, in turn.
      judge_every: steps between evaluations of all tunings' controllers.
      exchange_from: share of the steps after which, at each evaluation, tunings continue from the archive's best.
      judging: initial states of an evaluation.
      semifinal: initial states on which a front's best controllers are re-evaluated, to remove selection bias.
      final: unseen initial states on which the points of a front are measured.
      horizon: duration of all these evaluations' runs [s].
      judging_dt: step and control period of screening and evaluations [s].
      final_dt: step and control period of semifinal and final [s].
      success: share of the initial states that a point must settle from in semifinal and final.
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
