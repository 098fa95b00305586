"""Configuration of the search for trade-off fronts: the costs, and how much work is done."""

import math
from typing import TypeAlias

from cpjax.fields import config, count, number, renamed
from cpjax.sim.settings import check_whole_steps

COSTS = ("effort", "cart_travel", "voltage_variation")
"""Fields of `Metrics` that are traded against the settling time."""

Objective: TypeAlias = tuple[float, str]
"""A supply [V] and a cost: what one front is about."""


@renamed(
    fine="stop_penalty",
    price="multiplier",
    price_rate="multiplier_rate",
    dearest="multiplier_range",
    variety="initial_controllers",
    judge_every="evaluate_every",
    exchange_from="restart_from",
    judging="evaluation",
    judging_dt="evaluation_dt",
    semifinal="reevaluation",
)
@config
class FrontConfig:
    """Configuration of the search for trade-off fronts.

    No seed below 2**32 draws the same initial states by `cpjax.sample_starts`.
    """

    seed: int = count("of all random numbers", default=1, at_most=math.inf)
    bounds: int = count(
        "tunings for each cost and supply that have a bound on the cost, geometrically from lowest times the least "
        "cost among the candidates to the cost of the fastest; one more has no bound",
        default=39,
        at_least=1,
    )
    lowest: float = number("1", "factor of the lowest bound", default=0.85, above=0.0, at_most=0.999)
    stop_penalty: float = number(
        "1", "extra weight of each second lost when a run stops early", default=10.0, above=0.0
    )
    multiplier: float = number("s", "initial multiplier, of a cost in units of its bound", default=3.0, above=0.0)
    multiplier_rate: float = number(
        "1",
        "in each step the multiplier grows by a factor exp(multiplier_rate (cost / bound - 1))",
        default=1.0,
        above=0.0,
    )
    multiplier_range: float = number(
        "1",
        "the multiplier stays between its initial value divided and multiplied by this",
        default=100.0,
        at_least=1.0,
    )
    candidates: int = count("random controllers with which the search begins", default=16384, at_least=1)
    screening: int = count("initial states on which candidates are screened", default=16, at_least=1)
    steps: int = count("steps of the optimiser", default=100)
    batch: int = count("initial states of a step", default=8, at_least=1)
    learning_rate: float = number(
        "1", "initial learning rate of Adam; it falls to a tenth along a cosine", default=0.04, above=0.0, at_most=10.0
    )
    clip: float = number(
        "1",
        "each initial state's gradient is norm-clipped to this many times the batch's median norm",
        default=2.0,
        above=0.0,
    )
    duration: float = number("s", "duration of the tunings' rollouts", default=8.0, above=0.0)
    dt: float = number("s", "their step", default=0.02, above=0.0)
    spare_rate: float = number("1/s", "additional steps per second, for located crossings", default=20.0, above=0.0)
    width: float = number("rad and m", "width of the target", default=0.05, above=0.0)
    initial_controllers: int = count("best candidates from which the tunings begin, in turn", default=16, at_least=1)
    evaluate_every: int = count("steps between evaluations of all tunings' controllers", default=4, at_least=1)
    restart_from: float = number(
        "1",
        "share of the steps after which, at each evaluation, tunings continue from the archive's best",
        default=0.4,
        above=0.0,
        at_most=1.0,
    )
    explore: float = number(
        "1",
        "standard deviation of the noise on the unconstrained parameters of a tuning that continues from another "
        "controller; falls linearly to zero",
        default=0.15,
        at_least=0.0,
    )
    evaluation: int = count("initial states of an evaluation", default=96, at_least=1)
    reevaluation: int = count(
        "initial states on which a front's best controllers are re-evaluated, to remove selection bias",
        default=256,
        at_least=1,
    )
    final: int = count("unseen initial states on which the points of a front are measured", default=1024, at_least=1)
    horizon: float = number("s", "duration of all these evaluations' runs", default=20.0, above=0.0)
    evaluation_dt: float = number("s", "step and control period of screening and evaluations", default=0.004, above=0.0)
    final_dt: float = number("s", "step and control period of re-evaluation and final", default=0.002, above=0.0)
    success: float = number(
        "1",
        "share of the initial states that a point must settle from in re-evaluation and final",
        default=0.99,
        above=0.0,
        at_most=1.0,
    )

    def __post_init__(self) -> None:
        check_whole_steps(self, ("duration", "dt"), ("horizon", "evaluation_dt"), ("horizon", "final_dt"))


FrontPlan = FrontConfig
"""The name until version 0.1."""
