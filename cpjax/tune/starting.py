"""Controllers to begin a tuning with."""

import math
from typing import Literal, TypeAlias, get_args

import numpy as np

from cpjax import paper
from cpjax.controllers import AngleRateGate, EnergySwingUp, Hybrid, LqrWeights, LyapunovGate, PoleFactors, StateFeedback
from cpjax.errors import InputError
from cpjax.plant import CartPole, linearize

Beginning: TypeAlias = Literal["bland", "paper"]
GateKind: TypeAlias = Literal["angle-rate", "lyapunov"]


def beginning(name: str, design: paper.Design, plant: CartPole, gate: str = "angle-rate") -> Hybrid:
    """A controller with a design, an energy law and a gate, for `plant`.

    bland: round numbers that nobody has tuned. paper: the values of the paper, k = 0.2 with its Q and R or its poles,
    and its switch at 30 degrees, to which a gate of angle and rate comes as close as it can: with a rate of 8 sqrt(g /
    l), which a pendulum does not reach there.

    Args:
      gate: "angle-rate", an `AngleRateGate`; or "lyapunov", the level 1 of the design's own s' P s, which heeds the
        cart too: better where the cart has little room.

    Raises:
      InputError: an unknown name, or a plant for which the design has no gain.
    """
    if name not in get_args(Beginning):
        raise InputError("beginning", name, "one of " + ", ".join(get_args(Beginning)))
    if design not in get_args(paper.Design):
        raise InputError("design", design, "one of " + ", ".join(get_args(paper.Design)))
    if gate not in get_args(GateKind):
        raise InputError("gate", gate, "one of " + ", ".join(get_args(GateKind)))
    inputs: LqrWeights | PoleFactors = paper.design_inputs(design)
    if name == "bland" and design == "lqr":
        inputs = LqrWeights(np.diag([20.0, 5.0, 50.0, 2.0]), 1.0)
    found = inputs.solve(*linearize(plant))
    regulator = StateFeedback(found.K, design=inputs)
    opening = LyapunovGate(found.P, 1.0) if gate == "lyapunov" else None
    rate = math.sqrt(float(plant.gravity) / float(plant.pole_length))
    if name == "paper":
        swing_up = EnergySwingUp(plant, energy_gain=paper.ENERGY_GAIN)
        return Hybrid(swing_up, regulator, opening or AngleRateGate(paper.SWITCH_ANGLE, 8.0 * rate))
    swing_up = EnergySwingUp(plant, energy_gain=3.0, cart_stiffness=2.0, cart_damping=2.0)
    return Hybrid(swing_up, regulator, opening or AngleRateGate(0.5, 1.6 * rate))
