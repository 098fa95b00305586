"""Plants about a plant: for robustness, and for tuning over it."""

import dataclasses
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

    Args:
      only: the one parameter that is drawn; all of `UNCERTAIN` by default.

    Returns:
      A CartPole of arrays (count,), to be mapped over.

    Raises:
      InputError: a spread outside 0 to below 1, or another parameter.
    """
    Number("1", "spread", at_least=0.0, below=1.0).normalise("spread", spread)
    if only is not None and only not in UNCERTAIN:
        raise InputError("only", only, "one of " + ", ".join(UNCERTAIN))
    unit = np.random.default_rng(seed).uniform(-1.0, 1.0, size=(count, len(UNCERTAIN)))

    def drawn(part: Any) -> dict[str, Any]:
        columns = {}
        for name, rule in rules(type(part)).items():
            if isinstance(rule, Number):
                chosen = name in UNCERTAIN and only in (None, name)
                factor = 1.0 + spread * unit[:, UNCERTAIN.index(name)] if chosen else np.ones(count)
                columns[name] = float(getattr(part, name)) * factor
        return columns

    motor = dataclasses.replace(plant.motor, **drawn(plant.motor))
    return dataclasses.replace(plant, **drawn(plant), motor=motor)
