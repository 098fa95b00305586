"""Controllers to start a tuning with, by name."""

from typing import Literal, TypeAlias, get_args

from cpjax.controllers import DesignName, EnergySwingUp, Hybrid
from cpjax.errors import InputError
from cpjax.paper.printed import ENERGY_GAIN, SWITCH_ANGLE, design_inputs
from cpjax.plant import CartPole
from cpjax.tune.baseline import GateKind, assemble, baseline

Initial: TypeAlias = Literal["bland", "paper"]


def initial_controller(name: str, design: DesignName, plant: CartPole, gate: GateKind = "angle-rate") -> Hybrid:
    """Returns a controller with a design, an energy law and a gate, for a plant.

    bland: `cpjax.tune.baseline.baseline`, round numbers. paper: the values of the paper, k = 0.2 with its Q and R or
    its poles, and its switch at 30 degrees, to which a gate of angle and rate comes as close as it can: with a rate of
    8 sqrt(g / l), which a pendulum does not reach there.

    Raises:
      InputError: an unknown name, or a plant for which the design has no gain.
    """
    if name not in get_args(Initial):
        raise InputError("beginning", name, "one of " + ", ".join(get_args(Initial)))
    if name == "bland":
        return baseline(design, plant, gate)
    swing_up = EnergySwingUp(plant, energy_gain=ENERGY_GAIN)
    return assemble(swing_up, design_inputs(design), plant, gate, half_angle=SWITCH_ANGLE, rate=8.0)


beginning = initial_controller
"""The name until version 0.1."""
