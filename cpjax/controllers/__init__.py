"""What runs in the loop: laws, gates, and the hybrid controller that holds them."""

from cpjax.controllers.energy import EnergySwingUp
from cpjax.controllers.feedback import Design, LqrWeights, PoleFactors, StateFeedback
from cpjax.controllers.gates import AngleGate, AngleRateGate, Gate, LyapunovGate
from cpjax.controllers.hybrid import Hybrid
from cpjax.controllers.protocol import REGULATE, SWING_UP, Controller, Law, SingleLaw, SmoothController, as_controller
from cpjax.controllers.smooth import SmoothClip, SmoothHybrid

__all__ = [
    "REGULATE",
    "SWING_UP",
    "AngleGate",
    "AngleRateGate",
    "Controller",
    "Design",
    "EnergySwingUp",
    "Gate",
    "Hybrid",
    "Law",
    "LqrWeights",
    "LyapunovGate",
    "PoleFactors",
    "SingleLaw",
    "SmoothClip",
    "SmoothController",
    "SmoothHybrid",
    "StateFeedback",
    "as_controller",
]
