"""Reference points of the hypervolumes of trade-off fronts, and the pairs of supply and cost that are traced."""

import dataclasses
import math
from typing import TypeAlias, get_args

import numpy as np
from jaxtyping import Float

from cpjax.controllers import DesignName
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.rig import Rig, plant_of
from cpjax.study.fronts.config import COSTS, FrontConfig, Objective
from cpjax.study.fronts.evaluator import FINAL, Evaluator

Point: TypeAlias = Float[np.ndarray, "2"]
"""Mean settling time [s] and mean cost."""


@dataclasses.dataclass(frozen=True)
class ReferencePoints:
    """Reference points of the hypervolumes, the same for all designs.

    Attributes:
      baseline: for each design the baseline controller's settling time [s] and cost by (supply, cost); NaN where
        it settles from less than half of the initial states.
      reference: reference point by (supply, cost): in each coordinate 1.1 times the worst of the baselines; where
        there is none, the reference point at the plant's own supply.
    """

    baseline: dict[DesignName, dict[Objective, Point]]
    reference: dict[Objective, Point]


def objectives(plant: CartPole, supplies: tuple[float, ...] = ()) -> list[Objective]:
    """Returns the pairs that are traced: every cost at the plant's own supply, and effort at other supplies [V].

    Raises:
      InputError: a plant without a voltage limit.
    """
    own = float(plant.motor.voltage_limit)
    if not math.isfinite(own):
        raise InputError("plant.motor.voltage_limit", own, "a finite number: effort is measured by it")
    others = [supply for supply in dict.fromkeys(map(float, supplies)) if supply != own]
    return [*((own, cost) for cost in COSTS), *((supply, "effort") for supply in others)]


def reference_points(rig: CartPole | Rig, plan: FrontConfig, supplies: tuple[float, ...] = ()) -> ReferencePoints:
    """Computes the reference points from runs of the baseline controllers.

    Args:
      rig: the plant, or a rig, of which plant and track count.
      plan: the configuration, which gives the evaluation's initial states and steps.
      supplies: further voltage limits [V].

    Raises:
      InputError: a plant without a voltage limit, or on which no design's baseline controller settles from half of the
        initial states.
    """
    wanted = objectives(plant_of(rig), supplies)
    baseline: dict[DesignName, dict[Objective, Point]] = {}
    for design in get_args(DesignName):
        evaluator = Evaluator(rig, design, plan)
        start = np.asarray(evaluator.free.start())[None]
        found = {
            supply: evaluator.evaluate(start, supply, plan.final, FINAL) for supply in {supply for supply, _ in wanted}
        }
        baseline[design] = {
            objective: np.where(np.isfinite(point := found[objective[0]].points(objective[1], 0.5)[0]), point, np.nan)
            for objective in wanted
        }
    reference: dict[Objective, Point] = {}
    own = wanted[0][0]
    for objective in wanted:
        points = np.array([of[objective] for of in baseline.values()])
        points = points[np.isfinite(points[:, 0])]
        if not len(points) and objective[0] == own:
            raise InputError(
                "plant.motor.voltage_limit",
                own,
                "enough for the baseline controller to settle from half of the initial states",
            )
        reference[objective] = 1.1 * np.max(points, axis=0) if len(points) else reference[own, objective[1]]
    return ReferencePoints(baseline, reference)
