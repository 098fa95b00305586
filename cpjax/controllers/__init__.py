"""What runs in the loop: laws, gates, and the hybrid controller that holds them."""

from cpjax.controllers.energy import EnergySwingUp
from cpjax.controllers.feedback import StateFeedback
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
    "EnergySwingUp",
    "Gate",
    "Hybrid",
    "Law",
    "LyapunovGate",
    "SingleLaw",
    "SmoothClip",
    "SmoothController",
    "SmoothHybrid",
    "StateFeedback",
    "as_controller",
]
