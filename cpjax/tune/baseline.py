"""Untuned controllers: where a tuning starts, and what its result is compared with."""

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
    """Returns a controller of round, untuned numbers for a plant.

    Args:
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
      gate: "angle-rate", an `AngleRateGate`; or "lyapunov", the level 1 of the design's own s' P s, which depends on
        the cart too: better where the cart has little room.
      half_angle: of the gate of angle and rate [rad].
      rate: of the same, in units of sqrt(g / l).

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
