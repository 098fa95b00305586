"""Random plants around a nominal plant: to check robustness, and to tune over uncertain parameters."""

import numpy as np
from jaxtyping import Float

from cpjax.errors import InputError
from cpjax.plant import CartPole, Motor, parameter, parameters_of, with_parameters
from cpjax.pytree import Number, numbers

UNCERTAIN = tuple(name for name, rule in numbers(CartPole, Motor).items() if rule.uncertain)
"""Names of the uncertain parameters of a cart-pole and its motor. Others, such as gravity, count as known."""

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
# For a given seed the values of these do not depend on which other parameters exist: they share one table of random
# numbers, and every other parameter has a stream of its own. Do not add names here: that would change the values.


def sample_plants(plant: CartPole, count: int, *, spread: float, seed: int, only: str | None = None) -> CartPole:
    """Draws plants whose uncertain parameters are `plant`'s times a factor uniform in 1 - spread .. 1 + spread.

    A parameter that is zero is drawn between 0 and `spread` times the size declared with it: for the cart's friction
    `motor.damping`, for the pivot's a fifth of the pendulum's critical damping, 0.4 sqrt(m g l J). Values are clipped
    to the parameter's range.

    Args:
      plant: the nominal plant, of scalar parameters.
      count: number of plants.
      spread: largest relative deviation [1].
      seed: of the random numbers.
      only: the one parameter that is drawn; by default all that are declared uncertain, such as those of `UNCERTAIN`.

    Returns:
      A CartPole of arrays (count,), for `jax.vmap`.

    Raises:
      InputError: a count below 1, a spread that is negative or not below 1, a negative seed, or an `only` that is not
        an uncertain parameter.
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

    def drawn(name: str, rule: Number) -> Float[np.ndarray, " plants"]:
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
