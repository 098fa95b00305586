"""Controllers: laws, gates (switching regions), and the hybrid controller that combines them."""

from cpjax.controllers.digital import Digital, Estimator
from cpjax.controllers.energy import EnergySwingUp
from cpjax.controllers.estimators import FilteredDerivative, KalmanFilter, Observer, kalman_observer
from cpjax.controllers.feedback import Design, DesignName, LqrWeights, PoleFactors, StateFeedback
from cpjax.controllers.gates import AngleGate, AngleRateGate, Gate, LyapunovGate
from cpjax.controllers.hybrid import Hybrid
from cpjax.controllers.protocol import (
    REGULATE,
    SWING_UP,
    Clocked,
    Controller,
    Law,
    ModalController,
    ModeMemory,
    Sampled,
    SingleLaw,
    SmoothController,
    as_controller,
    as_sampled,
)
from cpjax.controllers.signal import VoltageSignal
from cpjax.controllers.smooth import SmoothClip, SmoothHybrid
from cpjax.controllers.tracking import IntegralAction, MovingReference

__all__ = [
    "REGULATE",
    "SWING_UP",
    "AngleGate",
    "AngleRateGate",
    "Clocked",
    "Controller",
    "Design",
    "DesignName",
    "Digital",
    "EnergySwingUp",
    "Estimator",
    "FilteredDerivative",
    "Gate",
    "Hybrid",
    "IntegralAction",
    "KalmanFilter",
    "Law",
    "LqrWeights",
    "LyapunovGate",
    "ModalController",
    "ModeMemory",
    "MovingReference",
    "Observer",
    "PoleFactors",
    "Sampled",
    "SingleLaw",
    "SmoothClip",
    "SmoothController",
    "SmoothHybrid",
    "StateFeedback",
    "VoltageSignal",
    "as_controller",
    "as_sampled",
    "kalman_observer",
]
