"""What trade-off fronts are measured by: from where hypervolumes are counted, and which pairs are traced at all."""

import dataclasses
import math
from typing import Any, get_args

import numpy as np

from cpjax.controllers import DesignName
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.study.fronts.config import COSTS, FrontConfig, Lane
from cpjax.study.fronts.evaluator import FINAL, Evaluator

Numbers = np.ndarray[Any, Any]


@dataclasses.dataclass(frozen=True)
class ReferencePoints:
    """What fronts are measured by, the same for all designs.

    Attributes:
      bland: of each design the bland controller's settling time and cost (2,) by (supply, cost); NaN where it settles
        from less than half of the starts.
      reference: of the hypervolumes (2,), by (supply, cost): 1.1 times the worse of the bland ones, and where there is
        none, what holds at the plant's own supply.
    """

    bland: dict[DesignName, dict[Lane, Numbers]]
    reference: dict[Lane, Numbers]


def lanes(plant: CartPole, supplies: tuple[float, ...] = ()) -> list[Lane]:
    """Every cost at the plant's own supply, and effort at others [V]."""
    own = float(plant.motor.voltage_limit)
    if not math.isfinite(own):
        raise InputError("plant.motor.voltage_limit", own, "a finite number: effort is measured by it")
    others = [supply for supply in dict.fromkeys(map(float, supplies)) if supply != own]
    return [*((own, cost) for cost in COSTS), *((supply, "effort") for supply in others)]


def reference_points(plant: CartPole, plan: FrontConfig, supplies: tuple[float, ...] = ()) -> ReferencePoints:
    """From runs of the bland controllers.

    Raises:
      InputError: a plant without a voltage limit, or at which neither design's bland controller settles.
    """
    wanted = lanes(plant, supplies)
    bland: dict[DesignName, dict[Lane, Numbers]] = {}
    for design in get_args(DesignName):
        evaluator = Evaluator(plant, design, plan)
        start = np.asarray(evaluator.free.start())[None]
        found = {
            supply: evaluator.evaluate(start, supply, plan.final, FINAL) for supply in {supply for supply, _ in wanted}
        }
        bland[design] = {
            lane: np.where(np.isfinite(point := found[lane[0]].points(lane[1], 0.5)[0]), point, np.nan)
            for lane in wanted
        }
    reference: dict[Lane, Numbers] = {}
    own = wanted[0][0]
    for lane in wanted:
        points = np.array([of[lane] for of in bland.values()])
        points = points[np.isfinite(points[:, 0])]
        if not len(points) and lane[0] == own:
            raise InputError(
                "plant.motor.voltage_limit", own, "enough for the bland controller to settle from half of the starts"
            )
        reference[lane] = 1.1 * np.max(points, axis=0) if len(points) else reference[own, lane[1]]
    return ReferencePoints(bland, reference)
