"""Plants about a plant: for robustness, and for tuning over it."""

import dataclasses
import math
from typing import Any

import numpy as np

from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.pytree import Number, rules

UNCERTAIN = (
    "cart_mass",
    "pole_mass",
    "pole_length",
    "cart_friction",
    "pivot_friction",
    "torque_constant",
    "back_emf_constant",
    "resistance",
)
"""Parameters that a rig's owner does not know well. Gravity and the supply are known."""


def sample_plants(plant: CartPole, count: int, *, spread: float, seed: int, only: str | None = None) -> CartPole:
    """`count` plants whose parameters are `plant`'s times a factor uniform in 1 - spread .. 1 + spread.

    A share of nothing is nothing: a friction that is zero is drawn between 0 and `spread` `motor.damping`, or
    times a fifth of the pendulum's critical damping, 0.4 sqrt(m g l J).

    Args:
      only: the one parameter that is drawn; all of `UNCERTAIN` by default.

    Returns:
      A CartPole of arrays (count,), to be mapped over.

    Raises:
      InputError: a count below 1, a spread outside 0 to below 1, a negative seed, or another parameter.
    """
    Number("1", "spread", at_least=0.0, below=1.0).normalise("spread", spread)
    for field, value, least in (("count", count, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise InputError(field, value, f"a whole number, at least {least}")
    if only is not None and only not in UNCERTAIN:
        raise InputError("only", only, "one of " + ", ".join(UNCERTAIN))
    unit = np.random.default_rng(seed).uniform(-1.0, 1.0, size=(count, len(UNCERTAIN)))

    weight = float(plant.pole_mass) * float(plant.gravity) * float(plant.pole_length)
    units = {
        "cart_friction": float(plant.motor.damping),
        "pivot_friction": 0.4 * math.sqrt(weight * float(plant.pivot_inertia)),
    }

    def drawn(part: Any) -> dict[str, Any]:
        columns = {}
        for name, rule in rules(type(part)).items():
            if isinstance(rule, Number):
                chosen = name in UNCERTAIN and only in (None, name)
                value = float(getattr(part, name))
                share = spread * unit[:, UNCERTAIN.index(name)] if chosen else np.zeros(count)
                columns[name] = np.abs(share) * units[name] if value == 0.0 and name in units else value * (1.0 + share)
        return columns

    motor = dataclasses.replace(plant.motor, **drawn(plant.motor))
    return dataclasses.replace(plant, **drawn(plant), motor=motor)
