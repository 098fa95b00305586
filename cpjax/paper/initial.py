"""Initial controllers of a tuning, by name."""

from typing import Literal, TypeAlias, get_args

from cpjax.controllers import DesignName, EnergySwingUp, Hybrid
from cpjax.errors import InputError
from cpjax.paper.printed import ENERGY_GAIN, SWITCH_ANGLE, design_inputs
from cpjax.plant import CartPole
from cpjax.tune.baseline import GateKind, assemble, baseline

Initial: TypeAlias = Literal["baseline", "paper"]


def initial_controller(name: str, design: DesignName, plant: CartPole, gate: GateKind = "angle-rate") -> Hybrid:
    """Returns the initial controller of a tuning, with an energy law, a designed regulator and a gate, for a plant.

    Args:
      name: "baseline" for `cpjax.tune.baseline.baseline`, with round numbers; "paper" for the paper's values, k = 0.2
        with its Q and R or its poles, and its switch at 30 degrees, which an angle-rate gate approximates by a rate of
        8 sqrt(g / l) that a pendulum does not reach there.
      design: "lqr" or "placement".
      plant: the plant, which is also the law's model.
      gate: "angle-rate" or "lyapunov"; see `cpjax.tune.baseline.assemble`.

    Raises:
      InputError: an unknown name, or a plant for which the design has no gain.
    """
    name = "baseline" if name == "bland" else name  # the name until version 0.1
    if name not in get_args(Initial):
        raise InputError("start_from", name, "one of " + ", ".join(get_args(Initial)))
    if name == "baseline":
        return baseline(design, plant, gate)
    swing_up = EnergySwingUp(plant, energy_gain=ENERGY_GAIN)
    return assemble(swing_up, design_inputs(design), plant, gate, half_angle=SWITCH_ANGLE, rate=8.0)


beginning = initial_controller
"""The name until version 0.1."""
