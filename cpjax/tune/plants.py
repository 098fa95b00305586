"""Plants about a plant: for robustness, and for tuning over it."""

from typing import Any

import numpy as np

from cpjax.errors import InputError
from cpjax.plant import CartPole, Motor, parameter, parameters_of, with_parameters
from cpjax.pytree import Number, numbers

UNCERTAIN = tuple(name for name, rule in numbers(CartPole, Motor).items() if rule.uncertain)
"""Parameters that a rig's owner does not know well. Gravity and the supply are known."""

_DRAWN_TOGETHER = (
    "cart_mass",
    "pole_mass",
    "pole_length",
    "cart_friction",
    "pivot_friction",
    "torque_constant",
    "back_emf_constant",
    "resistance",
)
# A seed names the same values of these whatever other parameters there are: they share one table of random numbers,
# and every other parameter has a stream of its own. Nothing is to be added here.


def sample_plants(plant: CartPole, count: int, *, spread: float, seed: int, only: str | None = None) -> CartPole:
    """`count` plants whose parameters are `plant`'s times a factor uniform in 1 - spread .. 1 + spread.

    A share of nothing is nothing: a parameter that is zero is drawn between 0 and `spread` times the size declared with
    it; of the cart's friction that is `motor.damping`, of the pivot's a fifth of the pendulum's critical damping,
    0.4 sqrt(m g l J). What would leave the parameter's range is put on its end.

    Args:
      only: the one parameter that is drawn; by default all that are declared uncertain, such as those of `UNCERTAIN`.

    Returns:
      A CartPole of arrays (count,), to be mapped over.

    Raises:
      InputError: a count below 1, a spread outside 0 to below 1, a negative seed, or another parameter.
    """
    Number("1", "spread", at_least=0.0, below=1.0).normalise("spread", spread)
    for field, value, least in (("count", count, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise InputError(field, value, f"a whole number, at least {least}")
    declared = parameters_of(plant)
    uncertain = [name for name, rule in declared.items() if rule.uncertain]
    if only is not None and only not in uncertain:
        raise InputError("only", only, "one of " + ", ".join(uncertain))
    together = np.random.default_rng(seed).uniform(-1.0, 1.0, size=(count, len(_DRAWN_TOGETHER)))

    def drawn(name: str, rule: Number) -> Any:
        value = float(parameter(plant, name))
        if not rule.uncertain or only not in (None, name):
            return np.full(count, value)
        if name in _DRAWN_TOGETHER:
            unit = together[:, _DRAWN_TOGETHER.index(name)]
        else:
            unit = np.random.default_rng([seed, *name.encode()]).uniform(-1.0, 1.0, size=count)
        share = spread * unit
        columns = np.abs(share) * rule.size(plant, "drawn") if value == 0.0 else value * (1.0 + share)
        return np.clip(columns, rule.at_least, rule.at_most)

    return with_parameters(plant, {name: drawn(name, rule) for name, rule in declared.items()})
