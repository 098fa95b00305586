"""cpjax: a motor-driven cart-pole in pure JAX.

From a plant, a controller and an initial state the package computes a trajectory, its metrics and their derivatives,
for one initial state or a million. Importing it starts no JAX backend, loads no plotting library and changes none of
JAX's settings.
"""

# First, and for its effect alone: an interrupt during the imports below, which take a second, then ends quietly.
from cpjax import startup as startup

# isort: split
import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from cpjax import _moved as _moved
from cpjax.backend.runtime import configure_cpu
from cpjax.controllers import (
    REGULATE,
    SWING_UP,
    AngleGate,
    AngleRateGate,
    Digital,
    EnergySwingUp,
    FilteredDerivative,
    Hybrid,
    IntegralAction,
    KalmanFilter,
    LqrWeights,
    LyapunovGate,
    MovingReference,
    Observer,
    PoleFactors,
    SmoothClip,
    SmoothHybrid,
    StateFeedback,
    VoltageSignal,
    as_sampled,
    kalman_observer,
)
from cpjax.errors import DamagedFileWarning, DerivativeWarning, InputError, PerformanceWarning
from cpjax.io import load, save
from cpjax.linear.discretization import discretize, discretize_cost
from cpjax.linear.estimation import dlqe
from cpjax.linear.lqr import dlqr, lqr
from cpjax.linear.placement import QuadraticFactors, place, place_polynomial
from cpjax.linear.riccati import care, dare
from cpjax.numeric.quantisation import quantize
from cpjax.plant import (
    HANGING,
    UPRIGHT,
    AccelerationActuator,
    CartPole,
    ForceActuator,
    LinearModel,
    LumpedMotor,
    Motor,
    State,
    linearize,
    sample_starts,
)
from cpjax.presets import preset
from cpjax.rig import (
    Disturbance,
    Drive,
    Encoders,
    Potentiometers,
    Pushes,
    RandomPushes,
    Rig,
    StateSensors,
    Track,
    Wind,
    rig,
)
from cpjax.sim.flags import Flag
from cpjax.sim.gradients import Gradients, gradients
from cpjax.sim.metrics import Metrics, ProtocolMetrics, TimeOutside
from cpjax.sim.rollout import Trajectory, measure, rollout
from cpjax.sim.settings import Simulation
from cpjax.sim.sweep import sweep
from cpjax.study.recording import read_sweep, record_sweep

try:
    __version__ = version("cpjax")
except PackageNotFoundError:  # run from a source tree that was never installed
    __version__ = "0+unknown"

__all__ = [
    "HANGING",
    "REGULATE",
    "SWING_UP",
    "UPRIGHT",
    "AccelerationActuator",
    "AngleGate",
    "AngleRateGate",
    "CartPole",
    "DamagedFileWarning",
    "DerivativeWarning",
    "Digital",
    "Disturbance",
    "Drive",
    "Encoders",
    "EnergySwingUp",
    "FilteredDerivative",
    "Flag",
    "ForceActuator",
    "Gradients",
    "Hybrid",
    "InputError",
    "IntegralAction",
    "KalmanFilter",
    "LinearModel",
    "LqrWeights",
    "LumpedMotor",
    "LyapunovGate",
    "Metrics",
    "Motor",
    "MovingReference",
    "Observer",
    "PerformanceWarning",
    "PoleFactors",
    "Potentiometers",
    "ProtocolMetrics",
    "Pushes",
    "QuadraticFactors",
    "RandomPushes",
    "Rig",
    "Simulation",
    "SmoothClip",
    "SmoothHybrid",
    "State",
    "StateFeedback",
    "StateSensors",
    "TimeOutside",
    "Track",
    "Trajectory",
    "VoltageSignal",
    "Wind",
    "__version__",
    "as_sampled",
    "care",
    "configure_cpu",
    "dare",
    "discretize",
    "discretize_cost",
    "dlqe",
    "dlqr",
    "gradients",
    "kalman_observer",
    "linearize",
    "load",
    "lqr",
    "measure",
    "paper",
    "place",
    "place_polynomial",
    "preset",
    "quantize",
    "read_sweep",
    "record_sweep",
    "rig",
    "rollout",
    "sample_starts",
    "save",
    "sweep",
]


def __getattr__(name: str) -> Any:
    """Imports `cpjax.paper`, the application, when it is first used."""
    if name == "paper":
        return importlib.import_module("cpjax.paper")
    raise AttributeError(f"module 'cpjax' has no attribute {name!r}")
