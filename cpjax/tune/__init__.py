"""Tuning of hybrid controllers by gradients through whole swing-ups.

`baseline` is in the module of its name. `tune` and `Tuning` are imported when they are first used, because importing
optax is slow.
"""

from typing import TYPE_CHECKING, Any

from cpjax.tune.config import TuningConfig
from cpjax.tune.objective import (
    Aggregate,
    Effort,
    EnergyError,
    Goal,
    Lagrangian,
    RemainingTime,
    TerminalCost,
    TrackExcess,
    Travel,
    VoltageVariation,
    WeightedSum,
    soft_maximum,
    success_weighted,
    tail_mean,
)
from cpjax.tune.parameters import FreeParameters, free_parameters
from cpjax.tune.plants import sample_plants

if TYPE_CHECKING:
    from cpjax.tune.outcome import Tuning
    from cpjax.tune.tuner import tune

__all__ = [
    "Aggregate",
    "Effort",
    "EnergyError",
    "FreeParameters",
    "Goal",
    "Lagrangian",
    "RemainingTime",
    "TerminalCost",
    "TrackExcess",
    "Travel",
    "Tuning",
    "TuningConfig",
    "VoltageVariation",
    "WeightedSum",
    "free_parameters",
    "sample_plants",
    "soft_maximum",
    "success_weighted",
    "tail_mean",
    "tune",
]


def __getattr__(name: str) -> Any:
    if name == "tune":
        from cpjax.tune.tuner import tune

        return tune
    if name == "Tuning":
        from cpjax.tune.outcome import Tuning

        return Tuning
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
