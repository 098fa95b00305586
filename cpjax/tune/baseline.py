"""Untuned baseline controllers: initial points of a tuning, and references for its result."""

import math
from typing import Literal, TypeAlias, get_args

import numpy as np

from cpjax.controllers import (
    AngleRateGate,
    DesignName,
    EnergySwingUp,
    Hybrid,
    LqrWeights,
    LyapunovGate,
    PoleFactors,
    StateFeedback,
)
from cpjax.errors import InputError
from cpjax.plant import CartPole, linearize

GateKind: TypeAlias = Literal["angle-rate", "lyapunov"]


def baseline(design: DesignName, plant: CartPole, gate: GateKind = "angle-rate") -> Hybrid:
    """Returns a controller with round, untuned parameters for a plant.

    Args:
      design: how the regulator's gain is computed, "lqr" or "placement".
      plant: the plant, which is also the swing-up law's model.
      gate: see `assemble`.

    Raises:
      InputError: an unknown name, or a plant for which the design has no gain.
    """
    if design not in get_args(DesignName):
        raise InputError("design", design, "one of " + ", ".join(get_args(DesignName)))
    inputs: LqrWeights | PoleFactors = PoleFactors.from_poles((-3.0, -4.0, -5.0, -6.0))
    if design == "lqr":
        inputs = LqrWeights(np.diag([20.0, 5.0, 50.0, 2.0]), 1.0)
    swing_up = EnergySwingUp(plant, energy_gain=3.0, cart_stiffness=2.0, cart_damping=2.0)
    return assemble(swing_up, inputs, plant, gate, half_angle=0.5, rate=1.6)


def assemble(
    swing_up: EnergySwingUp,
    inputs: LqrWeights | PoleFactors,
    plant: CartPole,
    gate: GateKind,
    *,
    half_angle: float,
    rate: float,
) -> Hybrid:
    """Returns a hybrid controller whose regulator and gate are computed for a plant.

    Args:
      swing_up: the swing-up law.
      inputs: weights or pole factors from which the regulator's gain is computed.
      plant: the plant whose linear model the gain is computed on.
      gate: "angle-rate", an `AngleRateGate`; or "lyapunov", the level set s' P s <= 1 of the design's own P, which
        depends on the cart's state too and suits a short track better.
      half_angle: half angle of the `AngleRateGate` [rad]; unused by "lyapunov".
      rate: rate of the `AngleRateGate`, in units of sqrt(g / l); unused by "lyapunov".

    Raises:
      InputError: an unknown gate, or a plant for which the design has no gain.
    """
    if gate not in get_args(GateKind):
        raise InputError("gate", gate, "one of " + ", ".join(get_args(GateKind)))
    found = inputs.solve(*linearize(plant))
    regulator = StateFeedback(found.K, design=inputs)
    if gate == "lyapunov":
        return Hybrid(swing_up, regulator, LyapunovGate(found.P, 1.0))
    frequency = math.sqrt(float(plant.gravity) / float(plant.pole_length))
    return Hybrid(swing_up, regulator, AngleRateGate(half_angle, rate * frequency))
