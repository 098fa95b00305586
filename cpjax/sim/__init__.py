"""Closed-loop simulation: rollouts, sweeps and gradients, and the loop behind them.

`rollout`, `measure`, `sweep` and `gradients` are exported by `cpjax` itself: their modules have their names.
"""

from cpjax.sim.flags import Flag
from cpjax.sim.gradients import Gradients
from cpjax.sim.integrators import INTEGRATORS
from cpjax.sim.metrics import Metric, Metrics, NoMetrics, ProtocolMetrics, Sample, TimeOutside
from cpjax.sim.plants import Eventful, Geometric, Plant
from cpjax.sim.rollout import Trajectory
from cpjax.sim.settings import Simulation

__all__ = [
    "INTEGRATORS",
    "Eventful",
    "Flag",
    "Geometric",
    "Gradients",
    "Metric",
    "Metrics",
    "NoMetrics",
    "Plant",
    "ProtocolMetrics",
    "Sample",
    "Simulation",
    "TimeOutside",
    "Trajectory",
]
