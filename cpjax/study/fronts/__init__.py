"""Fronts of controllers that trade settling time against effort, cart travel or voltage variation."""

from cpjax.study.fronts.config import COSTS, FrontConfig, Objective
from cpjax.study.fronts.reference_point import ReferencePoints, objectives, reference_points
from cpjax.study.fronts.trace import Front, Fronts, trace_fronts

__all__ = [
    "COSTS",
    "Front",
    "FrontConfig",
    "Fronts",
    "Objective",
    "ReferencePoints",
    "objectives",
    "reference_points",
    "trace_fronts",
]
